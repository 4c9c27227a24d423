"""Build hook of hatchling: a wheel holds the page with the npm packages that it needs."""

import pathlib
import subprocess

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageHook(BuildHookInterface):
    """Runs ``tools/build_page``; without npm an editable installation has no page, and a wheel is refused."""

    def initialize(self, version, build_data):
        """Called before a build; ``version`` is "standard" or "editable"."""
        root = pathlib.Path(self.root)
        subprocess.run([root / "tools" / "build_page"], check=True)
        if version == "standard" and not (root / "vinesim/web/page/vendor/three.module.js").is_file():
            raise SystemExit("a wheel needs the page: install Node.js with npm, then build again")
