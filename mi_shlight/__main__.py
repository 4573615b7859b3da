"""``python -m mi_shlight`` is the command ``mi-shlight``."""
import sys

from .cli import main

sys.exit(main())
