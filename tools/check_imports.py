"""Checks that packages only import packages below them, and that there are no import cycles.

The order is in pyproject.toml, `[tool.importlinter]`. Because `linprim_geo.eval` is in `eval/` of the repository, the
package is first assembled in a temporary folder, as in the wheel. Imports inside functions are checked, too.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    with TemporaryDirectory() as folder:
        package = Path(folder) / "linprim_geo"
        shutil.copytree(ROOT / "linprim_geo", package)
        shutil.copytree(ROOT / "eval", package / "eval")
        # The finder of an editable install would find the package in the repository, whatever the path.
        sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in type(finder).__module__]
        sys.path.insert(0, folder)
        os.chdir(folder)
        return lint_imports(config_filename=str(ROOT / "pyproject.toml"), cache_dir=None)


if __name__ == "__main__":
    sys.exit(main())
