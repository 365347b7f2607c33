"""What a browser would make of a page, as far as the tests ask."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

from PIL import Image

VOID = {"meta", "img", "br", "link", "hr", "input"}


class Page(HTMLParser):
    """Parses strictly: every element is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.loads: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.stack == [], f"never closed: {self.stack}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag not in VOID:
            self.stack.append(tag)
        if values.get("id"):
            self.ids.append(str(values["id"]))
        if tag == "img":
            self.images.append(values)
        if tag == "a":
            self.links.append(str(values["href"]))
        # Scripts stand in the page; `src` is looked at below.
        if tag in {"link", "iframe", "object", "embed"}:
            self.loads.append(tag)
        for name in ("src", "srcset", "data", "action", "poster"):
            if values.get(name):
                self.loads.append(str(values[name]))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack, f"</{tag}> closes nothing"
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.stack[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words)).strip()


def decoded(uri: str) -> Image.Image | str:
    """A raster image as Pillow sees it, an SVG as its text."""
    head, content = uri.split(",", 1)
    raw = base64.b64decode(content, validate=True)
    if head == "data:image/svg+xml;base64":
        return raw.decode("utf-8")
    image = Image.open(io.BytesIO(raw))
    image.load()
    return image
