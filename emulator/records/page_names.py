"""What the pages are called; importable without what draws them."""

REPORT = "report.html"
INDEX = "index.html"
