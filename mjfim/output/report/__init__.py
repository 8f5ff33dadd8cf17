"""The report of a folder of results: one HTML file with words, tables and interactive plots."""

# Name of the report in a folder of results.
REPORT = "report.html"
