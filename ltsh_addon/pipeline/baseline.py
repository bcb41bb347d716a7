"""Compares the errors of a comparison with those of an earlier one: what got worse, and where."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..reading import Malformed, check, read_json
from .comparison import percent
from .picture import REPORT

# Facts that two comparisons must share for their errors to be comparable.
_SAME = ("resolution", "sub_samples", "cycles_samples", "surface_samples", "reference")
_CLASSES = ("metals", "dielectrics")


@dataclass(frozen=True)
class Tolerance:
    """By how much an error may grow: an absolute number, 0.01 for one percent, or a `relative` share of the error."""

    value: float = 0.001
    relative: bool = False

    def allows(self, before: float, now: float) -> bool:
        """True where `now` is not worse."""
        return now <= before + (self.value * before if self.relative else self.value)

    def __str__(self):
        return f"{100.0 * self.value:g} % of it" if self.relative else percent(self.value)


@dataclass(frozen=True)
class Baseline:
    """The report.json of an earlier comparison."""

    path: Path
    pictures: dict[tuple, dict]  # by scene, camera and frame

    @classmethod
    def read(cls, path: Path) -> Baseline:
        """Raises OSError where the file is missing, ValueError where it is no report of a comparison."""
        try:
            document = read_json(path)
            check(document, {"reports": [REPORT]} if "reports" in document else REPORT)
        except OSError as error:
            raise OSError(f"baseline {path}: cannot be read ({error.strerror})") from error
        except Malformed as error:
            reason = f"is not the report of a comparison ({error})"
            raise ValueError(f"baseline {path}: {reason}, expected report.json of `ltsh compare`") from None
        pictures = _pictures(document)
        if not pictures:
            raise ValueError(f"baseline {path}: has no errors against Cycles, expected report.json of `ltsh compare`")
        return cls(path, pictures)

    def worse(self, report: dict, tolerance: Tolerance) -> list[str]:
        """A line for each error of `report` that is larger than here by more than the tolerance.

        Raises ValueError where the two cannot be compared: other pictures, sizes, samples, passes or techniques.
        """
        lines = []
        for key, now in _pictures(report).items():
            scene, camera, frame = key
            picture = f"{scene}, camera {camera!r}, frame {frame}"
            before = self.pictures.get(key)
            if before is None:
                raise ValueError(f"baseline {self.path}: has no picture of {picture}; make a baseline of the same job")
            for name in _SAME:
                if not _is_same(name, before[name], now[name]):
                    raise ValueError(
                        f"baseline {self.path}: {name} is {before[name]} for {picture}, but {now[name]} now; "
                        "use the same options, or make a new baseline"
                    )
            earlier = dict(_errors(before))
            for what, error in _errors(now):
                if what not in earlier:
                    raise ValueError(f"baseline {self.path}: has no {what} for {picture}; make a new baseline")
                if error is None or earlier[what] is None:
                    continue  # nothing was lit: there is no error
                if not tolerance.allows(earlier[what], error):
                    lines.append(
                        f"{picture}: {what}: error {percent(error)}, baseline {percent(earlier[what])}, "
                        f"tolerance {tolerance}"
                    )
        return lines


def _pictures(document: dict) -> dict[tuple, dict]:
    """The pictures of a report, of one or many, that were compared with Cycles; by scene, camera and frame."""
    reports = document.get("reports", [document])
    pictures = {}
    for report in reports:
        techniques = [row for figures in report["passes"].values() for row in figures["techniques"].values()]
        if any("against_cycles" in row for row in techniques):
            key = Path(report["scene"]).name, report["camera"], report["frame"]
            pictures[key] = {"passes": report["passes"], **{name: report[name] for name in _SAME}}
    return pictures


def _is_same(name, before, now) -> bool:
    if name == "reference":
        # Only its presence and number of samples must agree; its error estimate is a result.
        return (before or {}).get("of") == (now or {}).get("of") and (before is None) == (now is None)
    return before == now


def _errors(picture: dict) -> Iterator[tuple[str, float | None]]:
    """Label and value of each error of a picture; None where nothing was lit."""
    for pass_name, figures in picture["passes"].items():
        for technique, row in figures["techniques"].items():
            label = f"{pass_name} of {technique}"
            yield f"{label} against Cycles", row.get("against_cycles", {}).get("unbiased_relative_error")
            reference = row.get("against_reference", {})
            yield f"{label} against the reference", reference.get("relative_l2")
            for material in _CLASSES:
                yield f"{label} against the reference on {material}", reference.get(material, {}).get("relative_l2")
