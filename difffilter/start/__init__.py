"""Where a run begins: fits of the first rows to positions, ranges, bearings."""
