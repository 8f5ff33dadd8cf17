"""The report of a result: one HTML file with words, tables and interactive plots."""

# Name of the report in a folder of results.
REPORT = "report.html"
