"""What makes the files that the package ships. `python -m release` lists them."""
