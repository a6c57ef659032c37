"""What `make docs` does besides: pages from elsewhere and the command line's join those of docs/, and links follow."""

from __future__ import annotations

import posixpath
import re
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from lightdepth.command_line.reference import reference

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()(?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")
COMMAND_LINE = "command-line.md"
"""A page that lies nowhere: it is made from the options themselves."""
ELSEWHERE = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "data/**/*.md", "lightdepth/weights/*.md")


@cache
def places() -> dict[str, str]:
    """Where each page and picture of the site is, by where it lies in the repository."""
    found = {"README.md": "index.md"}
    for pattern in ELSEWHERE:
        found |= {(name := path.relative_to(ROOT).as_posix()): name for path in sorted(ROOT.glob(pattern))}
    docs = ROOT / "docs"
    found |= {f"docs/{(name := p.relative_to(docs).as_posix())}": name for p in docs.rglob("*.*") if p.suffix != ".py"}
    return found | {f"docs/{COMMAND_LINE}": COMMAND_LINE}


def on_files(files: Any, config: Any) -> Any:
    """The pages from elsewhere."""
    for source, name in places().items():
        if not source.startswith("docs/"):
            files.append(File.generated(config, name, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, COMMAND_LINE, content=reference()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links as the site has them; what it does not have is named and leads nowhere."""
    known = places()
    here = page.file.src_uri
    source = next(path for path, name in known.items() if name == here)

    def led(link: re.Match[str]) -> str:
        target = known.get(posixpath.normpath(posixpath.join(posixpath.dirname(source), link[2])))
        if target is None:
            return "](#)"
        return f"]({posixpath.relpath(target, posixpath.dirname(here) or '.')}{link[3] or ''})"

    return LINK.sub(led, markdown)
