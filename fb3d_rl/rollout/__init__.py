"""From trials to rows: one row per scheduled trial, also for one that crashes."""
