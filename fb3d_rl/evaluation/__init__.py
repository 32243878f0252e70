"""From trials to what people read: rows, tables with intervals, the report."""
