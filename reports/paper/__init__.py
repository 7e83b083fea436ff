"""Parts of the page that `python -m reports.reproduce_paper` writes; `book` is what they write it with."""
