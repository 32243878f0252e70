"""Articulated objects: readers of PartNet-Mobility and UMPNet folders, catalogs, splits."""
