"""What is printed about pictures: a table of errors, or a line for each of many."""

from __future__ import annotations


def percent(value) -> str:
    """A share as text."""
    return "-" if value is None else f"{100.0 * value:.2f} %"


def unbiased(figures: dict) -> str:
    """The error against two noisy halves; its square is negative where the noise is all there is to see."""
    squared = figures.get("unbiased_squared_error")
    return "in noise" if squared is not None and squared < 0.0 else percent(figures.get("unbiased_relative_error"))


def lines(report: dict, seconds: dict) -> list[str]:
    """A table of one picture: errors and seconds per pass and technique."""
    found = []
    for pass_name, figures in report["passes"].items():
        noise = f", noise of Cycles {percent(figures['noise'])}" if "noise" in figures else ""
        found.append(f"{pass_name}{noise}")
        heads = f"{'vs Cycles':>12}{'vs reference':>14}{'metals':>10}{'dielectrics':>13}{'s':>8}"
        found.append(f"  {'technique':<12}{heads}")
        for name, row in figures["techniques"].items():
            reference = row.get("against_reference", {})
            classes = [percent(reference.get(label, {}).get("relative_l2")) for label in ("metals", "dielectrics")]
            cycles, truth = unbiased(row.get("against_cycles", {})), percent(reference.get("relative_l2"))
            errors = f"{cycles:>12}{truth:>14}{classes[0]:>10}{classes[1]:>13}"
            took = seconds.get("techniques", {}).get(name, {}).get(pass_name)
            found.append(f"  {name:<12}{errors}" + (f"{took:>8.2f}" if took is not None else f"{'-':>8}"))
    return found


def short_lines(report: dict) -> list[str]:
    """A line for a picture: the errors of one pass, against Cycles where there is one."""
    passes = report["passes"]
    pass_name = "specular" if "specular" in passes else next(iter(passes))
    errors = []
    for name, row in passes[pass_name]["techniques"].items():
        if "against_cycles" in row:
            errors.append(f"{name} {unbiased(row['against_cycles'])}")
        elif "against_reference" in row:
            errors.append(f"{name} {percent(row['against_reference']['relative_l2'])}")
    return [f"{report['name']:<32}" + (f" {pass_name}: " + ", ".join(errors) if errors else "")]
