"""`python -m linprim_geo` is `linprim-geo`."""

import sys

# Python puts the folder it is called in first, which may be a downloaded capture: no module may come from there.
# What it has imported before this line only `python -P -m linprim_geo` and `linprim-geo` guard.
if not sys.flags.safe_path:
    del sys.path[0]

from linprim_geo.cli.main import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
