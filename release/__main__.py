"""`python -m release`: what is here, a line or two each."""

from pathlib import Path

from benchmarks import list_modules

print(list_modules("release", Path(__file__).parent))
