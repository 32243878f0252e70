"""From trials to rows: one row per scheduled trial, whatever happens in it."""
