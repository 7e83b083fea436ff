"""What is written from evaluations and measurements: tables, figures, comparisons. `python -m reports` lists them."""
