"""Makes the modules of `bench/analysis` importable."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
