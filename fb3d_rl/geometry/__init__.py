"""Rigid transforms, quaternions and point operations: plain batched torch, no other part of the package."""
