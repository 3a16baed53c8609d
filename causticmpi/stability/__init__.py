"""A laboratory of failure: one question a page, answered by a chart, a table and a sentence with its figure."""
