"""report.json, report.html and the index of pictures."""

import html
import json
import math
import os
import posixpath
import re
import urllib.parse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..files import write_bytes
from ..reading import NUMBER, Malformed, check, file_name, read_json, some
from ..scene import listed, shortened

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 78rem; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; margin-bottom: 0.2rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
img { width: 100%; border: 1px solid #ddd; image-rendering: pixelated; } p.facts { color: #666; margin-top: 0; }
table { border-collapse: collapse; }
td, th { padding: 0.25rem 0.8rem; text-align: right; border-bottom: 1px solid #ddd; }
p.labels { display: flex; margin: 0; } p.labels span { flex: 1; text-align: center; font-weight: 600; }
td:first-child, th:first-child { text-align: left; } li { margin: 0.2rem 0; }
"""
_COLUMNS = (
    ("against_cycles", "unbiased_relative_error", "vs Cycles"),
    ("against_cycles", "bias", "bias"),
    ("against_reference", "relative_l2", "vs reference"),
    ("against_reference", "median_relative_error", "median"),
    ("against_reference", "percentile_95_relative_error", "95 %"),
)


def json_text(document) -> str:
    """`document` as JSON text: NaN and Inf become null, numpy scalars and arrays plain numbers and lists."""
    return json.dumps(_plain(document), indent=2, ensure_ascii=False, allow_nan=False)


def write_json(path: str | os.PathLike, document) -> None:
    """Write `json_text(document)` atomically."""
    write_bytes(path, (json_text(document) + "\n").encode())


def _plain(value):
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# What differs between warnings of one kind: names as `repr` quotes them, and numbers.
_ONE = r"""(?:(?<!\w)(?:'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")|\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?(?: %)?)"""
_VARYING, _MEMBER = re.compile(_ONE), re.compile(f"{_ONE}(?: {_ONE})*")
_MORE = re.compile(r"(.*) \((\d+) more: (.*)\)\Z", re.DOTALL)
# A warning with a phrase of NOTES is about a setting, or the same in Cycles, and comes last; one with a phrase of
# ABSENT is about something that is not in the picture, and comes first.
_NOTES = ("switched off", "as in Cycles", "nor does Cycles", "as rendered", "on the processor", "only view layer")
_NOTES += ("lights were", "as they were", "is Cycles' own", "only guides", "so the techniques do not")
_ABSENT = (" black", "not shaded", "lights nothing", "could not be read", "missing", "left out", "not finite")
MOST_SHOWN, NAMED = 8, 3  # warnings on a screen, and others of its kind that a warning on a screen names


def grouped(lines: Iterable[str]) -> list[str]:
    """Warnings, the most harmful first, those of one kind in one: "object 'A': it glows (2 more: 'B'; 'C')".

    Warnings are of one kind if only names and numbers differ. Harm: first what is absent from the picture, last what
    is the same in Cycles, in between by the largest percentage in the line.
    """
    kinds: dict[str, tuple[str, dict[str, None]]] = {}
    for line in sorted(dict.fromkeys(lines), key=_harm):
        head, _, members = _MORE.match(line).groups() if _MORE.match(line) else (line, 0, "")
        first, others = kinds.setdefault(_VARYING.sub("\0", head), (head, {}))
        known = _VARYING.findall(first)
        new = " ".join(one for one, its in zip(_VARYING.findall(head), known, strict=True) if one != its)
        others |= dict.fromkeys(one for one in (new, *_MEMBER.findall(members)) if one and one not in known)
    return [f"{head} ({len(more)} more: {'; '.join(more)})" if more else head for head, more in kinds.values()]


def _harm(line: str) -> tuple[int, float]:
    rank = 2 if any(map(line.__contains__, _NOTES)) else 0 if any(map(line.__contains__, _ABSENT)) else 1
    return rank, -max((float(one) for one in re.findall(r"(\d+(?:\.\d+)?) %", line)), default=0.0)


def on_screen(warnings: Iterable[str], rest: str = "report.json") -> list[str]:
    """The first `MOST_SHOWN` of `grouped` warnings with fewer names, and a line about those in the `rest`."""

    def shorter(match) -> str:
        return f"{match[1]} ({match[2]} more: {listed(_MEMBER.findall(match[3]), NAMED, '; ')})"

    lines = grouped(warnings)
    more = len(lines) - MOST_SHOWN
    shown = [_MORE.sub(shorter, line) for line in lines[:MOST_SHOWN]]
    return [*shown, f"{more} more kinds of warnings are in {rest}"] if more > 0 else shown


def write_html(folder: str | os.PathLike, page: str, files: Sequence[str], texts: tuple, report: Mapping) -> None:
    """Write the page `page` of a comparison's `report`, atomically.

    It links the `files`, the layers (EXR) and the sheet (PNG). All are paths below `folder`, which has report.json.
    `texts` are the labels of the sheet's columns and the lines about its rows.
    """
    layers, sheet, figures = (_link(page, name) for name in (*files, "report.json"))
    labels = "".join(f"<span>{_text(label)}</span>" for label in texts[0])
    legend = "".join(f"<li>{_text(line)}</li>" for line in texts[1])
    warnings = "".join(f"<li>{_text(warning)}</li>" for warning in report["warnings"])
    warnings = f"<ul>{warnings}</ul>" if warnings else "<p>None: everything in the scene was shaded.</p>"
    width, height = report["resolution"]
    facts = ", ".join(
        (
            f"camera {report['camera']}",
            f"frame {report['frame']}",
            f"{width} x {height} pixels",
            *_picture_facts(report),
            f"{report['sub_samples']} sub-samples ({report['pixel_filter']})",
            f"{report['cycles_samples']} Cycles samples",
            *(f"{name} {version}" for name, version in report["versions"].items()),
        )
    )
    body = [
        f"<h1>{_text(report['scene'])}</h1>",
        f'<p class="facts">{_text(facts)}</p>',
        *(f"<p><strong>{_text(problem)}</strong></p>" for problem in report.get("problems", ())),
        f'<p class="labels">{labels}</p>',
        f'<a href="{sheet}"><img src="{sheet}" alt="Cycles and the techniques, with signed errors"></a>',
        "<p>Below each row of pictures their errors, technique − Cycles: red is too bright, blue too dark. From the "
        f"top:</p><ol>{legend}</ol>",
        *(_pass_table(name, figures) for name, figures in report["passes"].items()),
        f"<h2>Warnings</h2>{warnings}",
        f'<p>All layers: <a href="{layers}">{layers}</a>. All figures: <a href="{figures}">report.json</a>.</p>',
    ]
    write_bytes(os.path.join(folder, page), _page(f"{report['scene']}: comparison", body))


def write_overview(folder: str | os.PathLike, page: str, report: Mapping) -> None:
    """Write the page of many comparisons: one line each, with the errors of one pass and a link to its own page."""
    pictures, rows = report["reports"], []
    techniques = list(dict.fromkeys(name for picture in pictures for name in _shown(picture)[1]["techniques"]))
    for picture in pictures:
        link = next((file for file in picture["files"] if file.endswith(".html")), "")
        figures = _shown(picture)[1]
        cells = [figures.get("noise")] + [
            figures["techniques"].get(name, {}).get("against_cycles", {}).get("unbiased_relative_error")
            for name in techniques
        ]
        name = f'<a href="{_link(page, link)}">{_text(picture["name"])}</a>'
        texts = [name, _text(picture["camera"]), str(picture["frame"]), *map(_percent, cells)]
        rows.append(f"<tr>{''.join(f'<td>{text}</td>' for text in texts)}</tr>")
    heads = ["picture", "camera", "frame", "noise of Cycles", *techniques]
    problems = [*report["problems"], *(f"{name} is missing" for name in report.get("missing", ()))]
    body = [
        f"<h1>{len(pictures)} comparisons</h1>",
        f'<p class="facts">{_text(_shown(pictures[0])[0]) if pictures else "no"} radiance, error against Cycles</p>',
        *([f"<ul>{''.join(f'<li>{_text(problem)}</li>' for problem in problems)}</ul>"] if problems else []),
        f"<table><tr>{''.join(f'<th>{_text(head)}</th>' for head in heads)}</tr>{''.join(rows)}</table>",
        '<p>All figures: <a href="report.json">report.json</a>.</p>',
    ]
    write_bytes(os.path.join(folder, page), _page(f"{len(pictures)} comparisons", body))


def _shown(picture: Mapping) -> tuple[str, Mapping]:
    """Name and figures of the pass of a picture that the overview shows: specular if there is one, else the first."""
    name = "specular" if "specular" in picture["passes"] else next(iter(picture["passes"]))
    return name, picture["passes"][name]


def _page(title: str, body: list[str]) -> bytes:
    text = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{_text(title)}</title><style>{_STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    return text.encode()


def _link(page: str, name: str) -> str:
    """The link from the page to the file `name`; both are paths below the same folder."""
    return _text(urllib.parse.quote(posixpath.relpath(name, posixpath.dirname(page) or ".")))


def _picture_facts(report: Mapping) -> list[str]:
    """Facts about a picture: its color space, and render region, pixel aspect and exposure if they are not plain."""
    facts, border = [f"colors in {report['color_space']}"], report["border"]
    if border is not None:
        facts.append(
            f"render region at {border['left']}, {border['top']} of {border['full_width']} x {border['full_height']}"
        )
    if report["pixel_aspect"] != 1.0:
        facts.append(f"pixels {report['pixel_aspect']:g} times as wide as high")
    if report["exposure"] != 1.0:
        facts.append(f"film exposure {report['exposure']:g}")
    return facts


def _pass_table(name: str, figures: Mapping) -> str:
    head = "".join(f"<th>{_text(label)}</th>" for _, _, label in _COLUMNS)
    rows = [
        f"<tr><td>{_text(technique)}</td>"
        + "".join(f"<td>{_percent(row.get(section, {}).get(key))}</td>" for section, key, _ in _COLUMNS)
        + "</tr>"
        for technique, row in figures["techniques"].items()
    ]
    noise = f", noise of the Cycles reference {_percent(figures['noise'])}" if "noise" in figures else ""
    return f"<h2>{_text(name)}{noise}</h2><table><tr><th>technique</th>{head}</tr>{''.join(rows)}</table>"


def _percent(value) -> str:
    return "–" if value is None else f"{100.0 * value:.3f} %"


def _text(value) -> str:
    return html.escape(str(value))


FILE = "index.json"
_GROUP = {
    "files": {str: file_name},
    "labels": {str: str},
    "names": some([str]),
    "passes": some([str]),
    "scales": {str: NUMBER},
    "figures?": {str: {"noise?": NUMBER | None, "techniques": {str: {str: NUMBER | None}}}},
}


def _check_group(group, location) -> None:
    check(group, _GROUP, location)
    rows = [name for figures in group.get("figures", {}).values() for name in figures["techniques"]]
    for names, known in (((*group["names"], *rows), "labels"), (group["passes"], "scales")):
        if missing := [name for name in names if name not in group[known]]:
            raise Malformed(f"{location}.{known} has no {shortened(missing[0], 60)!r}")


_REPORT = {"warnings?": [str], "problems?": [str]}
_INDEX = {"command": str, "partial": str, "report": _REPORT, "groups": some({str: _check_group})}


def write_index(folder: Path, index: dict) -> None:
    """Write the index. Raises OSError."""
    write_json(Path(folder) / FILE, index)


def read_index(folder: Path) -> dict:
    """The index in `folder`. Raises OSError, and ValueError, naming the file, where it is damaged."""
    path = Path(folder) / FILE
    try:
        return read_json(path, _INDEX)
    except Malformed as error:
        raise ValueError(f"{path}: {error}; shade or bake again") from error


def index_stamp(folder: Path) -> tuple[int, int]:
    """Modification time and size of the index, which tell whether it has changed. Raises OSError."""
    status = (Path(folder) / FILE).stat()
    return status.st_mtime_ns, status.st_size
