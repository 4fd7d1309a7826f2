"""Makes the README's relative links absolute, because PyPI shows it far from the repository.

    python scripts/absolute_links.py https://github.com/USER/NAME TAG

Run when a release is built (.github/workflows/release.yml), which is when the repository's address is known.
"""

import re
import sys
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"
RELATIVE_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)")
"""`[text](path)` or `![text](path)`: whether it is a picture, the text, the path."""


def absolute(text: str, repository: str, revision: str) -> str:
    """Markdown whose relative links lead to a revision of a repository on GitHub."""

    def link(match: re.Match) -> str:
        picture, words, path = match.groups()
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/{revision}/{path})"

    return RELATIVE_LINK.sub(link, text)


if __name__ == "__main__":
    README.write_text(absolute(README.read_text(), *sys.argv[1:]))
