"""Hook of hatchling: the long description of the package is README.md with links that work outside a checkout."""

import pathlib
import re

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)\s]+)\)")
"""A link of Markdown to a file of the checkout: "!" for a picture, text, path."""


def long_description(readme: str, source: str | None) -> str:
    """Returns README.md as the long description of a package.

    With ``source``, the address of a folder of the checkout on the web, links to files begin with this address. Without
    it they become plain text, and lines and table rows of pictures are left out.
    """
    readme = re.sub(r"<!-- place: .*? -->\n", "", readme)  # which is for tests of the pages
    if source:
        return LINK.sub(lambda link: f"{link[1]}[{link[2]}]({source.rstrip('/')}/{link[3]})", readme)
    blocks = [block for block in readme.split("\n\n") if not re.search(r"!\[", block)]
    return LINK.sub(lambda link: link[2], "\n\n".join(blocks))


class ReadmeHook(MetadataHookInterface):
    """Sets the field ``readme`` of the package's metadata."""

    def update(self, metadata):
        """Called before a build with the table ``project`` of pyproject.toml, which it completes."""
        source = (self.config or {}).get("source")  # the address, once the repository is public
        text = long_description((pathlib.Path(self.root) / "README.md").read_text(), source)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
