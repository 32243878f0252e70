"""Depth cameras that return world points with link ids, and viewpoint sampling."""
