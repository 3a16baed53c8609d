"""The report: one HTML file that needs nothing beside it, its pictures embedded as data URIs."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from causticmpi.compare.tables import Table, to_csv, to_html
from causticmpi.output.directory import write_whole

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1280px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.7em; } h2 { margin-top: 2.2em; border-bottom: 1px solid #ccc; } h3 { margin-top: 1.6em; }
table { border-collapse: collapse; font-size: 0.85em; font-variant-numeric: tabular-nums; }
th { text-align: left; border-bottom: 2px solid #888; vertical-align: bottom; }
td { border-bottom: 1px solid #ddd; white-space: nowrap; } td:nth-child(2):last-child { white-space: normal; }
th, td { padding: 0.25em 0.9em 0.25em 0; }
.wide { overflow-x: auto; } .note, figcaption { font-size: 0.85em; color: #555; max-width: 60em; }
figure { margin: 1.2em 0; } img { max-width: 100%; height: auto; } .alarm { color: #b00020; font-weight: bold; }
"""


@dataclass(frozen=True)
class Image:
    """An embedded picture: the bytes of a PNG or JPEG, and its caption."""

    name: str
    data: bytes
    caption: str

    @property
    def suffix(self) -> str:
        """png or jpeg, by the content."""
        return "png" if self.data.startswith(b"\x89PNG") else "jpeg"


@dataclass(frozen=True)
class Section:
    """A heading (level 2), paragraphs, and what follows in order."""

    title: str
    paragraphs: Sequence[str]
    content: Sequence[Table | Image]
    alarm: str = ""


def save(path: Path, data: bytes) -> None:
    """A whole file or none, in a directory that is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write_bytes(data))


def save_apart(out: Path, sections: Sequence[Section]) -> None:
    """Every picture as a file in out/figures, every table as CSV in out/tables."""
    for section in sections:
        for item in section.content:
            if isinstance(item, Image):
                save(out / "figures" / f"{item.name}.{item.suffix}", item.data)
            else:
                save(out / "tables" / f"{item.name}.csv", to_csv(item).encode())


def page(title: str, introduction: Sequence[str], sections: Sequence[Section]) -> str:
    """The whole HTML text."""
    body = [f"<h1>{html.escape(title)}</h1>", *map(_paragraph, introduction)]
    links = ", ".join(f'<a href="#s{i}">{html.escape(s.title)}</a>' for i, s in enumerate(sections))
    body.append(f"<p>{links}</p>")
    for i, section in enumerate(sections):
        body.append(f'<h2 id="s{i}">{html.escape(section.title)}</h2>')
        if section.alarm:
            body.append(f'<p class="alarm">{html.escape(section.alarm)}</p>')
        body += map(_paragraph, section.paragraphs)
        body += [_image(item) if isinstance(item, Image) else _table(item) for item in section.content]
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>\n'


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _table(table: Table) -> str:
    return f"<h3>{html.escape(table.title)}</h3>{to_html(table)}"


def _image(image: Image) -> str:
    data = base64.b64encode(image.data).decode("ascii")
    caption = html.escape(image.caption)
    source = f"data:image/{image.suffix};base64,{data}"
    return f'<figure><img alt="{caption}" src="{source}"><figcaption>{caption}</figcaption></figure>'
