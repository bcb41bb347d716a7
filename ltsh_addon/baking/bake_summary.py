"""What is printed about bakes: files, texels, errors."""

from __future__ import annotations

from ..comparison.comparison_summary import percent


def lines(report: dict, seconds: dict) -> list[str]:
    """Of one scene, camera and frame: a line per file, and errors where there are any."""
    found = []
    for record in report["objects"]:
        for tile in record["tiles"].values():
            took = seconds.get(tile["file"])
            found.append(f"{tile['file']:<40}{tile['texels']:>10} texels" + (f"{took:>8.2f} s" if took else ""))
            for pass_name, figures in tile.get("errors", {}).items():
                for name, error in figures["techniques"].items():
                    beside = "in noise" if error["unbiased_squared_error"] < 0.0 else percent(error["unbiased_error"])
                    noise = f"(noise {percent(figures['noise'])})"
                    found.append(f"  {name + '.' + pass_name:<30}{beside:>10} beside Cycles {noise}")
    return found


def short_lines(report: dict) -> list[str]:
    """The same without times, for one of several."""
    return [f"{report['name']}:", *(f"  {line}" for line in lines(report, {}))]
