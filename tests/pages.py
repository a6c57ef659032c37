"""What a page of ours asks a browser for: pictures that stand in it, and links to files beside it."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote


class References(HTMLParser):
    """Every picture and link of a page, and its tags."""

    def __init__(self, text: str):
        super().__init__()
        self.pictures: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [unquote(value) for name, value in attrs if name == "href" and value]
        self.pictures += [value for name, value in attrs if name in ("src", "srcset", "data", "action") and value]


def check_self_contained(path: Path) -> References:
    """Nothing is loaded from anywhere, and links lead to files that lie beside the page."""
    text = path.read_text(encoding="utf-8")
    page = References(text)
    assert not {"link", "iframe", "base"} & set(page.tags)  # of programs it has its own alone: none has an address
    assert not re.search(r"https?://|url\(|@import", text)
    for address in page.pictures:
        assert re.match("data:image/(png|jpeg|webp);base64,", address)
        assert base64.b64decode(address.split(",", 1)[1]).startswith((b"\x89PNG", b"\xff\xd8", b"RIFF"))
    folder = path.parent.resolve()
    assert all((folder / link).is_file() and (folder / link).resolve().is_relative_to(folder) for link in page.links)
    return page
