"""From rows to numbers: intervals, tables, comparisons, published numbers beside them."""
