"""`python -m tables fit|validate|optimum|plot|export|page ...`: makes, measures and exports the lookup tables.

Needs scipy, and `plot` matplotlib, which the add-on does not need.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from ltsh_addon.files import write_bytes
from ltsh_addon.pipeline.options import one_table
from ltsh_addon.shading import SHIPPED_TABLES, TableError, load_table

from . import bench, export, families, fit, header, layouts, optimum, pack, sheen, validate
from .families import BRDFS

FOLDER = Path(__file__).resolve().parent
_LAYOUT_NAMES = ", ".join(layouts.LAYOUTS)


def main(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except (TableError, OSError) as error:
        print(f"tables: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("tables: interrupted; the same command goes on from here", file=sys.stderr)
        return 130


def _parser():
    parser = argparse.ArgumentParser(prog="python -m tables")
    actions = parser.add_subparsers(dest="action", required=True, metavar="fit|validate|optimum|plot|export|page")
    default = f"default: {', '.join(SHIPPED_TABLES)}"
    fitting = actions.add_parser("fit", help="fit tables; goes on where a fit of the same settings was stopped")
    names = f"ltc, ltsh1 to ltsh8, or these with a c; {default}"
    fitting.add_argument("names", nargs="*", type=_fitted_name, metavar="TABLE", help=names)
    fitting.add_argument("-o", dest="output", type=Path, default=FOLDER, metavar="OUT", help="folder; default: tables")
    fitting.add_argument("--brdf", choices=BRDFS, default="ggx", help="other BRDFs get the name <brdf>_<table>")
    fitting.add_argument("--size", type=_size, default=64, metavar="N", help="nodes per axis, default 64")
    fitting.add_argument("--jobs", type=_jobs, default=2, metavar="N", help="tables at a time, default 2")
    fitting.add_argument("--pack", action="store_true", help="fit the pack to the shipped tables instead")
    fitting.set_defaults(run=_fit_all)
    single = actions.add_parser("fit-one")
    for name, kind in (("name", _name), ("path", Path), ("brdf", str), ("size", int)):
        single.add_argument(name, type=kind)
    single.set_defaults(run=_fit_one)
    checking = actions.add_parser("validate", help="measure tables between their nodes")
    checking.add_argument("names", nargs="*", metavar="TABLE", help=f"or a path; {default}")
    checking.add_argument("--count", type=_size, default=28, metavar="N", help="points per axis, default 28")
    checking.add_argument("--pack", action="store_true", help="the tables of the pack beside the shipped ones")
    checking.add_argument("--json", action="store_true", help="one JSON document on stdout")
    checking.set_defaults(run=_validate)
    bounding = actions.add_parser("optimum", help="the least error of families of lobes at single points")
    bounding.add_argument("names", nargs="*", type=_name, metavar="FAMILY", help=f"as for fit; {default}")
    bounding.add_argument("--count", type=_size, default=optimum.COUNT, metavar="N", help="points per axis, default 12")
    bounding.add_argument(
        "--grazing", action="store_true", help="beside the shipped tables at n.v 0.04 to 0.2, per roughness and n.v"
    )
    bounding.add_argument(
        "--all",
        action="store_true",
        help="those of the picture, 6 points per axis, into tables/optimum.json: 5 minutes",
    )
    bounding.set_defaults(run=_optimum)
    plotting = actions.add_parser("plot", help="draw the figures of tables/README.md")
    plotting.add_argument("-o", dest="output", type=Path, default=FOLDER.parent / "docs", metavar="OUT")
    plotting.set_defaults(run=_plot)
    exporting = actions.add_parser("export", help="for other engines: images, a header for C, C++, GLSL and HLSL, WGSL")
    exporting.add_argument(
        "names", nargs="*", type=_table, metavar="TABLE", help="or a path (.npz); default: all shipped"
    )
    exporting.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="folder for the files")
    exporting.add_argument(
        "--layout",
        choices=(*layouts.LAYOUTS, "pack"),
        metavar="LAYOUT",
        help=f"LTC as one engine takes it: {_LAYOUT_NAMES}; or pack: all tables in one small texture",
    )
    exporting.add_argument(
        "--two-curves", action="store_true", help="only F = 1 and (1 - c)^5: smaller, dielectrics are Schlick's"
    )
    exporting.add_argument("--json", action="store_true", help="name the files on stdout in one JSON document")
    exporting.set_defaults(run=_export)
    paging = actions.add_parser("page", help="a page that compares the techniques in a browser, without a network")
    paging.add_argument("-o", dest="output", type=Path, required=True, metavar="FOLDER", help="folder for the page")
    width = f"pixels of the pictures, a multiple of 16, default {bench.WIDTH}"
    paging.add_argument("--width", type=_width, default=bench.WIDTH, metavar="N", help=width)
    paging.set_defaults(run=_page)
    return parser


def _name(text):
    try:
        families.family_named(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _table(text):
    try:
        return one_table(text)[0]
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _fitted_name(text):
    if "+" in text:
        raise argparse.ArgumentTypeError(f"table {text!r}: a sum of two lobes cannot be fitted, only its optimum found")
    return _name(text)


def _number(text, lowest, what):
    if text.isdecimal() and int(text) >= lowest:
        return int(text)
    raise argparse.ArgumentTypeError(f"{what} is {text!r}, expected a whole number of at least {lowest}")


def _size(text):
    return _number(text, 4, "size")


def _width(text):
    width = _number(text, 16, "width")
    if width % 16:
        raise argparse.ArgumentTypeError(f"width is {width}, expected a multiple of 16")
    return width


def _jobs(text):
    return _number(text, 1, "number of jobs")


def _fit_all(options) -> int:
    """Fit each table in an interpreter of its own with a single thread, so that the bytes do not depend on threads."""
    if options.pack:
        return _fit_pack(options)
    folder = options.output.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    # The largest first, so that the others share the remaining time.
    names = sorted(dict.fromkeys(options.names or SHIPPED_TABLES), key=lambda name: -families.family_named(name).size)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    running, waiting, failed = {}, list(names), False
    shares, shown = dict.fromkeys(names, "0 %"), ""
    try:
        while running or waiting:
            while waiting and len(running) < options.jobs:
                name = waiting.pop(0)
                prefix = "" if options.brdf == "ggx" else f"{options.brdf}_"
                path = folder / f"{prefix}{name}.npz"
                command = [sys.executable, "-m", "tables", "fit-one", name, str(path), options.brdf, str(options.size)]
                child = subprocess.Popen(command, cwd=FOLDER.parent, env=environment, stdout=subprocess.PIPE, text=True)
                reader = threading.Thread(target=_follow, args=(child, name, shares), daemon=True)
                reader.start()
                running[name] = (child, reader)
            time.sleep(0.2)
            for name in [name for name, (child, _) in running.items() if child.poll() is not None]:
                child, reader = running.pop(name)
                reader.join()
                failed |= child.returncode != 0
            shown = _show(shares, shown)
    finally:
        for child, _ in running.values():
            child.terminate()
            child.wait()
        if sys.stderr.isatty():
            print(file=sys.stderr)
    return 1 if failed else 0


def _fit_pack(options) -> int:
    """Fit all tables of the pack in this process."""
    progress = functools.partial(print, file=sys.stderr, flush=True)
    channels = {name: pack.fit_table(name, progress) for name in pack.TABLES} | {"sheen": sheen.fit()}
    options.output.mkdir(parents=True, exist_ok=True)
    write_bytes(options.output / pack.PATH.name, header.dds(pack.pack_layers(channels)))
    return 0


def _show(shares, shown):
    """Print the progress of the fits if it has changed: on one line of a terminal, otherwise a line per finished
    fit."""
    text = ", ".join(f"{name} {share}" for name, share in shares.items())
    if sys.stderr.isatty():
        if text != shown:
            print(f"\r{text}", end="", file=sys.stderr, flush=True)
    elif text.count("fitted") != shown.count("fitted"):
        print(text, file=sys.stderr, flush=True)
    return text


def _follow(child, name, shares):
    for line in child.stdout:
        shares[name] = line.strip()


def _fit_one(options) -> int:
    try:
        return _fit_and_write(options)
    except KeyboardInterrupt:
        return 130


def _fit_and_write(options) -> int:
    start = time.perf_counter()
    family, model, path = families.family_named(options.name), BRDFS[options.brdf], options.path
    checkpoint = fit.Checkpoint(path.with_suffix(".progress"), fit.settings(family, model, options.size))

    def show(fraction):
        print(f"{100.0 * fraction:.0f} %", flush=True)

    fitted = fit.fit(family, options.size, model=model, progress=show, checkpoint=checkpoint)
    fit.write_table(path, fitted)
    checkpoint.remove()
    print(f"fitted in {time.perf_counter() - start:.0f} s")
    return 0


def _validate(options) -> int:
    if options.pack:
        return _validate_pack(options)
    results = {}
    for name in options.names or SHIPPED_TABLES:
        table = load_table(name)
        results[name] = {
            **validate.validate(table, options.count).to_dict(),
            **validate.validate_corners(table, max(options.count // 2, 4)).to_dict(),
        }
        basis = validate.fresnel_basis_error(table, max(options.count // 4, 2))
        results[name]["layouts"] = validate.layout_errors(table, options.count)
        results[name]["fresnel_basis"] = {str(ior): error for ior, error in basis.items()}
    # These errors belong to no table: all techniques with a table shade such lobes alike.
    brushed = {} if options.names else validate.validate_anisotropic(max(options.count // 9, 2))
    if options.json:
        print(json.dumps({**results, "anisotropic": brushed} if brushed else results, indent=2))
    else:
        print(_as_text(results))
        print(_anisotropic_text(brushed) if brushed else "", end="")
    return 0


def _validate_pack(options) -> int:
    print("| table | mean | shipped | median | shipped | smooth | shipped | albedo | shipped | curvature | shipped |")
    print("|---" * 11 + "|")
    for name, packed in pack.load_pack().items():
        cells = []
        for measured in (packed, load_table(name)):
            errors = validate.validate(measured, options.count)
            smooth = validate.validate_corners(measured, max(options.count // 2, 4)).smooth_mean
            curved = validate.curvature(measured, options.count)
            cells.append([f"{errors.mean:.4f}", f"{errors.median:.4f}", f"{smooth:.4f}",
                          f"{100.0 * errors.albedo_mean:.3f} %", f"{curved:.3f}"])  # fmt: skip
        print(f"| `{name}` | {' | '.join(f'{ours} | {full}' for ours, full in zip(*cells, strict=True))} |", flush=True)
    found, albedo = sheen.errors(sheen.load_sheen(), options.count)
    print(f"\nsheen beside that of Cycles: mean {found.mean():.4f}, median {np.median(found):.4f}, "
          f"albedo {albedo.mean():.4f} (largest {albedo.max():.4f})")  # fmt: skip
    return 0


def _anisotropic_text(brushed):
    lines = ["", "| node | anisotropy | techniques | largest | `reference` | largest |", "|---" * 6 + "|"]
    for kind, rows in brushed.items():
        for anisotropy, found in rows.items():
            keys = ("technique", "technique_maximum", "reference", "reference_maximum")
            cells = " | ".join(f"{100.0 * found[key]:.2f} %" for key in keys)
            lines.append(f"| {kind} | {anisotropy} | {cells} |")
    return "\n".join([*lines, ""])


def _as_text(results):
    lines = ["| table | mean | median | 90 % | max | solved | light | albedo mean | max | negative mean | max |"]
    lines.append("|---" * 11 + "|")
    keys = ("mean", "median", "percentile_90", "maximum", "solved_mean", "light_error")
    shares = ("albedo_mean", "albedo_maximum", "negative_mass_mean", "negative_mass_maximum")
    for name, found in results.items():
        cells = [f"{found[key]:.4f}" for key in keys] + [f"{100.0 * found[key]:.3f} %" for key in shares]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    lines += ["", "| table | smooth mean | max | corner albedo | largest step | largest number | dielectrics |"]
    lines.append("|---" * 7 + "|")
    for name, found in results.items():
        worst = max(max(errors) for errors in found["fresnel_basis"].values())
        albedo = f"{found['lowest_albedo']:.4f} to {found['highest_albedo']:.4f}"
        cells = [f"{found[key]:.4f}" for key in ("smooth_mean", "smooth_maximum")]
        cells += [albedo, f"{found['largest_albedo_step']:.4f}", f"{found['largest_number']:.1f}"]
        lines.append(f"| `{name}` | {' | '.join(cells)} | {100.0 * worst:.2f} % |")
    lines += ["", "| table | mean | half floats | loss | two textures |", "|---" * 5 + "|"]
    for name, found in results.items():
        mean, half, textures = found["mean"], found["layouts"]["half"], found["layouts"].get("two_textures")
        last = "" if textures is None else f"{textures:.4f}"
        lines.append(f"| `{name}` | {mean:.4f} | {half:.4f} | {100.0 * (half / mean - 1.0):.2f} % | {last} |")
    return "\n".join(lines)


def _optimum(options) -> int:
    if options.grazing:
        return _grazing(options)
    if options.all:
        options.names, options.count = optimum.all_families(), optimum.COUNT_OF_ALL
    print("| family | coefficients | moments | mean | median | 90 % | max | shipped table: mean | median |")
    print("|---" * 9 + "|")
    for name in options.names or SHIPPED_TABLES:
        best = optimum.optimum(name, options.count)
        if options.all:
            optimum.keep_optimum(best)
        found = best.errors
        cells = [found.mean(), np.median(found), np.quantile(found, 0.9), found.max()]
        if name in SHIPPED_TABLES:
            errors = validate.error_map(load_table(name), options.count)
            cells += [errors.mean(), np.median(errors)]
        size = f"{families.family_named(name).size} | {optimum.edge_terms(name)}"
        print(f"| `{name}` | {size} | {' | '.join(f'{cell:.4f}' for cell in cells)} |", flush=True)
    return 0


def _grazing(options) -> int:
    """Print shaded errors and L2 errors of a table, and those of the lobe solved at the point itself."""
    names = [name for name in options.names or ["ltsh4"] if name in SHIPPED_TABLES and name != "ltc"]
    if not names:
        print("tables: --grazing needs a shipped table of spherical harmonics: ltsh2 or ltsh4", file=sys.stderr)
        return 2
    for name in names:
        found = optimum.grazing_errors(load_table(name), min(options.count, len(optimum.ROUGHNESS)))
        print(f"| `{name}` roughness | n.v | shaded error | solved | ratio | L2 error | solved | ratio |")
        print("|---" * 8 + "|")
        for row in found:
            errors = f"{row.table:.4f} | {row.solved:.4f} | {row.ratio:.2f}"
            lobes = f"{row.table_lobe:.4f} | {row.solved_lobe:.4f} | {row.table_lobe / row.solved_lobe:.2f}"
            print(f"| {row.roughness:.2f} | {row.cosine:.3f} | {errors} | {lobes} |")
        table, solved = (np.sqrt(np.mean([getattr(row, key) ** 2 for row in found])) for key in ("table", "solved"))
        ratios = np.array([row.ratio for row in found])
        print(f"root mean square {table:.4f}, solved {solved:.4f}, ratio {table / solved:.2f}; "
              f"ratio at most {ratios.max():.2f}, above {optimum.GOAL} at {np.count_nonzero(ratios > optimum.GOAL)} "
              f"of {len(ratios)} points", flush=True)  # fmt: skip
    return 0


def _plot(options) -> int:
    options.output.mkdir(parents=True, exist_ok=True)
    for path in optimum.draw_all(options.output, lambda text: print(text, file=sys.stderr, flush=True)):
        print(path)
    return 0


def _export(options) -> int:
    try:
        prefixes = export.export_prefixes(options.names or (["ltc"] if options.layout else SHIPPED_TABLES))
        if options.layout == "pack" and options.names:
            raise ValueError("--layout pack writes all shipped tables; give no TABLE")
        if options.layout and options.two_curves:
            raise ValueError(f"--layout {options.layout} has two curves anyway; leave --two-curves out")
        if options.layout and len(prefixes) > 1:
            raise ValueError(f"--layout {options.layout} writes the files of one table, not of {len(prefixes)}")
    except ValueError as error:
        print(f"tables: {error}", file=sys.stderr)
        return 2
    if options.layout == "pack":
        files = {"pack": export.export_pack(options.output)}
    elif options.layout:
        layout, (name,) = layouts.LAYOUTS[options.layout], prefixes
        files = {name: export.export_layout(layout, name, options.output)}
        for text in layout.dropped:
            print(f"tables: warning: {name} in {layout.engine}: {text}", file=sys.stderr)
    else:
        files = export.export_tables(prefixes, options.output, two_curves=options.two_curves)
    licenses = [str(path) for path in export.write_licenses(options.output, code=options.layout in (None, "pack"))]
    paths = {name: [str(path) for path in written] for name, written in files.items()}
    shown = {"tables": paths, "licenses": licenses}
    print(json.dumps(shown, indent=2) if options.json else "\n".join(sum(paths.values(), []) + licenses))
    return 0


def _page(options) -> int:
    for path in bench.write_page(options.output, options.width, lambda text: print(text, file=sys.stderr, flush=True)):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
