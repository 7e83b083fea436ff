"""`python -m benchmarks`: what is here, a line or two each."""

from pathlib import Path

from benchmarks import list_modules

print(list_modules("benchmarks", Path(__file__).parent))
