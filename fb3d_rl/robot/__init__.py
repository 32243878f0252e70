"""A robot arm before a depth camera: its stages as functions of plain arrays, which a real cell can feed as well."""
