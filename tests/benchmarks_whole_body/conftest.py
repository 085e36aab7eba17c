"""The benchmarks are scripts beside the package: the root comes last, so that the installed package is tested."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))
