"""Hook of mkdocs that adds pages of the repository outside docs/ to the site.

Links work both in the repository and on the site: `../SECURITY.md` in a page of docs/ becomes
`SECURITY.md`, and `docs/fleet.md` in a page at the top of the repository becomes `fleet.md`.
"""

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File, Files

ROOT: Final = Path(__file__).resolve().parents[1]
PAGES: Final = (
    *("README.md", "SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "CITATION.cff"),
    *("firmware/README.md", "firmware/PROTOCOL.md", "firmware/settings.h", "config/gateway.toml"),
)


def on_files(files: Files, config: Any) -> Files:
    """Add pages of the repository, and the pictures and files that pages link to."""
    texts = [path.read_text() for path in (ROOT / "docs").glob("*.md")]
    linked = {name for text in texts for name in re.findall(r"\]\(\.\./([^)#\s]+)", text)}
    pictures = {str(path.relative_to(ROOT)) for path in ROOT.glob("firmware/*.svg")}
    for name in sorted({*PAGES, *pictures, *linked}):
        if (ROOT / name).is_file():
            target = "repository.md" if name == "README.md" else name
            files.append(File.generated(config, target, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Adapt the links of a page to its location in the site."""
    name = page.file.src_uri
    if name in PAGES or name == "repository.md":
        depth = "../" if "/" in name else ""
        markdown = re.sub(r"\]\((?:\.\./)?docs/", f"]({depth}", markdown)
    else:
        markdown = markdown.replace("](../", "](")
    markdown = re.sub(r"\]\((\.\./)?README\.md", r"](\1repository.md", markdown)
    return markdown if "/" not in name else markdown.replace("](repository.md", "](README.md")
