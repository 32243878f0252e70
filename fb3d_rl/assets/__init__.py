"""Articulated objects: PartNet-Mobility and UMPNet folders, procedural objects, splits."""
