"""`python -m linprim_geo` is `linprim-geo`."""

import sys

from linprim_geo.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
