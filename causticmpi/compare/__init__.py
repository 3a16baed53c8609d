"""`causticmpi compare`: equal-time runs against references; metrics, tables, charts, one report."""
