"""`python -m tables fit|validate [TABLE ...]`, what `ltsh tables` runs from the source checkout."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from ltsh_addon.shading import TableError, load_table

from . import fit, validate

FOLDER = Path(__file__).resolve().parent


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ltsh tables")
    parser.add_argument("action", choices=("fit", "validate"))
    parser.add_argument("names", nargs="*", metavar="TABLE", help=f"of {', '.join(fit.FAMILIES)}; default: all")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in fit.FAMILIES]
    if unknown:
        parser.error(f"table {unknown[0]!r} is unknown, expected some of {', '.join(fit.FAMILIES)}")
    for name in options.names or fit.FAMILIES:
        if options.action == "fit":
            _fit(name)
        else:
            try:
                print(json.dumps({name: validate.validate(load_table(name)).to_dict()}))
            except TableError as error:
                print(f"ltsh tables: {error}", file=sys.stderr)
                return 1
    return 0


def _fit(name: str) -> None:
    start = time.perf_counter()

    def show(fraction):
        print(f"\r{name}: {100.0 * fraction:3.0f} %", end="", file=sys.stderr, flush=True)

    arrays, errors = fit.fit(fit.FAMILIES[name], progress=show)
    fit.write_table(FOLDER / f"{name}.npz", fit.FAMILIES[name], arrays, errors)
    seconds = time.perf_counter() - start
    print(f"\r{name}: fitted in {seconds:.0f} s, node error mean {errors.mean():.4f}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
