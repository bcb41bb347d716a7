"""Lookup tables for other engines: the files of `python -m tables export` (tables/EXPORT.md).

The EXR has every stored quantity as a channel over the grid of the table. The header (.h) has all numbers and the
functions that shade with them, the .wgsl these functions, the .dds the numbers as textures.
"""

import json
import os
import re
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ltsh_addon.files import replacing
from ltsh_addon.imaging.exr import write_channels
from ltsh_addon.lobes.lookup_table import MIN_ALPHA, WARP_REGULARIZATION, LookupTable, basis_integrals
from ltsh_addon.scene import VERSION
from ltsh_addon.shading import load_table

from . import header, layouts, pack, sheen

_WARP_NAMES = ("A", "B", "C", "tilt")


def export_tables(
    prefixes: Mapping[str, str], folder: str | os.PathLike, *, two_curves: bool = False
) -> dict[str, list[Path]]:
    """Write the tables of `export_prefixes` into `folder`, created if needed; returns the files by table. With
    `two_curves` they have only F = 1 and (1 - c)^5.

    All tables are read before anything is written. The files of a table appear all or none. Raises TableError,
    OSError.
    """
    tables = {given: load_table(given) for given in prefixes}
    if two_curves:
        tables = {given: pack.with_two_curves(table) for given, table in tables.items()}
    folder = _made(folder)
    files = {}
    for given, table in tables.items():
        files[given] = export_table(table, Path(given).stem, prefixes[given], folder)
    return files


def _made(folder) -> Path:
    """The folder, created if needed."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"output folder {folder}: cannot be made ({error.strerror}); choose another folder") from error
    return folder


def export_prefixes(given: list[str] | tuple[str, ...]) -> dict[str, str]:
    """The prefix of the names in the header of each table, a shipped one or a path.

    Raises ValueError where two tables have the same prefix.
    """
    prefixes: dict[str, str] = {}
    for name in dict.fromkeys(given):
        prefix = identifier(Path(name).stem)
        other = next((other for other, taken in prefixes.items() if taken == prefix), None)
        if other is not None:
            raise ValueError(f"tables {other} and {name} would get the same names ({prefix}); export one at a time")
        prefixes[name] = prefix
    return prefixes


def identifier(name: str) -> str:
    """`name` as a prefix of identifiers in C and GLSL that does not clash with "gl" or "ltsh"."""
    words = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return words if re.match(r"[a-z]", words) and words not in ("gl", "ltsh") else f"table_{words}".rstrip("_")


def export_table(table: LookupTable, name: str, prefix: str, folder: Path) -> list[Path]:
    """Write the files of a table to `folder`, all or none; returns them. Raises OSError, TableError."""
    about = _about(table, name)
    contents = {
        **_code(name, header.header_text(table, prefix, about), prefix),
        f"{name}.dds": header.dds(header.half_layers(table)),
    }
    if table.family == "ltc":
        for number, texture in enumerate(layouts.layout_textures(layouts.LAYOUTS["three"], table), start=1):
            contents[f"{name}_{number}.dds"] = header.dds(texture[None])
    image = folder / f"{name}.exr"
    with ExitStack() as stack:
        written = _write(contents, folder, stack)
        # The image takes its name here, the other files when their contexts end.
        write_channels(image, table_channels(table), _attributes(table))
    return [image, *written]


def export_layout(layout: layouts.Layout, given: str, folder: str | os.PathLike) -> list[Path]:
    """Write a table, shipped or a path, as an engine takes it; all files or none. Raises OSError, TableError."""
    contents = layouts.layout_files(layout, load_table(given))
    with ExitStack() as stack:
        return _write(contents, _made(folder), stack)


def export_pack(folder: str | os.PathLike) -> list[Path]:
    """Write the pack (`pack.py`): three array textures, and code for each of its tables and sheen. Raises OSError."""
    contents = {f"{name}.dds": header.dds(pack.layers()[:count]) for name, count in pack.LAYERS.items()}
    for name, first in pack.FIRST_LAYERS.items():
        prefix, where = f"pack_{name}", _ABOUT_PACK.format(size=pack.SIZE, layer=first)
        if name == "sheen":
            text = header.sheen_text(sheen.load_sheen(), prefix, _about_sheen(prefix) + where)
        else:
            table = pack.load_pack()[name]
            text = header.header_text(table, prefix, _about(table, prefix) + where)
        contents |= _code(prefix, text, prefix)
    with ExitStack() as stack:
        return _write(contents, _made(folder), stack)


def _code(name, text, prefix) -> dict[str, bytes]:
    """The header of a table and its WGSL, by the name of the file."""
    texts = {f"{name}.h": text, f"{name}.wgsl": header.wgsl_text(text, prefix)}
    return {file: content.encode("ascii") for file, content in texts.items()}


_ABOUT_PACK = """
The numbers of the nodes are {size} x {size} coefficients of cubic B-splines. The textures pack_*.dds have them too,
from layer {layer} on, four channels to a layer, roughness down the rows. The rest of the data is here alone."""


def write_licenses(folder: str | os.PathLike, *, code: bool = True) -> list[Path]:
    """Write the licenses of exported files beside them: CC0 of the numbers and, with `code`, MIT. Raises OSError."""
    contents = {"LICENSE-CC0.txt": Path(__file__).with_name("LICENSE").read_bytes()}
    if code:
        notice = re.search(r"Copyright .*?(?= \*/)", header.TEMPLATE.read_text(encoding="ascii"), re.DOTALL)[0]
        notice = notice.replace("\n   ", "\n")
        contents["LICENSE-MIT.txt"] = f"MIT License\n\n{notice}\n".encode("ascii")
    with ExitStack() as stack:
        return _write(contents, Path(folder), stack)


def _write(contents, folder, stack) -> list[Path]:
    """Write files by name; they take their names when `stack` ends."""
    for name, data in contents.items():
        stack.enter_context(replacing(folder / name)).write_bytes(data)
    return [folder / name for name in contents]


def table_channels(table: LookupTable) -> dict[str, np.ndarray]:
    """All quantities (R, T), float32, by the name of their channel; row 0 is roughness 0, column 0 is theta_o = 0."""
    channels = {f"warp.{_WARP_NAMES[n]}": table.warp[..., n] for n in range(table.warp.shape[2])}
    albedo = _directional_albedo(table)
    for curve in range(table.coefficients.shape[2]):
        for k, suffix in enumerate(_coefficient_suffixes(table)):
            channels[f"curve{curve}.c{suffix}"] = table.coefficients[:, :, curve, k]
        channels[f"curve{curve}.albedo"] = albedo[..., curve]
        average = table.average_albedo[:, None, curve]
        channels[f"curve{curve}.average_albedo"] = np.broadcast_to(average, table.warp.shape[:2])
    return {name: np.ascontiguousarray(plane, dtype=np.float32) for name, plane in channels.items()}


def _coefficient_suffixes(table) -> list[str]:
    if table.family == "ltc":
        return [""]
    suffixes = [f"_{l}_{m}" for l in range(table.degree + 1) for m in range(l + 1)]  # noqa: E741 (the field's letter)
    return suffixes if table.bend is None else [*suffixes, "_bent_x", "_bent_z"]


def _directional_albedo(table) -> np.ndarray:
    """(R, T, F): the integral of the lobe of every node and curve over the hemisphere."""
    coefficients = table.coefficients.astype(float)
    if table.family == "ltc":
        return coefficients[..., 0] * (0.5 + 0.5 * np.cos(table.warp[..., 3:].astype(float)))
    return coefficients @ basis_integrals(coefficients.shape[-1])


def _attributes(table) -> dict[str, str]:
    """EXR attributes as JSON; with them the image alone is enough to rebuild the table."""
    conventions = {
        "license": "CC0-1.0",
        "table": table.name,
        "family": table.family,
        "degree": table.degree,
        "made_by": f"python -m tables export, LTSH {VERSION}",
        "rows": "top to bottom: roughness, uniform from 0 to 1; alpha = roughness^2 of GGX",
        "columns": "left to right: theta_o, uniform in 1 - sqrt(1 - theta_o / 90 deg) from 0 to 1",
        "frame": "z is the shading normal, the view direction is (sin theta_o, 0, cos theta_o)",
        "lobe": "BRDF times cosine in sr^-1 = D_orig(W w / |W w|) |W| / |W w|^3",
        "W": "[[A g^2, 0, A B g sin(theta_o)], [0, C, 0], [0, 0, 2 max(alpha, min_alpha)]]",
        "g^2": f"cos^2(theta_o) + {WARP_REGULARIZATION**2} max(alpha, min_alpha)^2 sin^2(theta_o)",
        "min_alpha": MIN_ALPHA,
        "D_orig": _original(table),
        "lookup": "bilinear in the stored channels",
        "fresnel_curves": _curve_names(table),
        "fit": table.metadata,
    }
    fresnel = {
        "cosine_count": table.fresnel_curves.shape[1],
        "curves": table.fresnel_curves.tolist(),
        "ior": table.fresnel_ior.tolist(),
        "dielectric_weights": table.fresnel_weights.tolist(),
    }
    return {"ltsh:conventions": json.dumps(conventions), "ltsh:fresnel": json.dumps(fresnel)}


def _original(table) -> str:
    if table.family == "ltc":
        return "c max(0, w . (sin(tilt), 0, cos(tilt))) / pi"
    harmonics = "sum c_l_m Y_lm, Y_lm = K_lm P_l^(m)(z) Re((x + i y)^m), orthonormal, P_l^(m) the m-th derivative"
    if table.bend is None:
        return harmonics
    xx, xz, yy = table.bend
    bent = f"(v_x c_bent_x + v_z c_bent_z) |V| / (pi |v|^4), v = V w, V = [[{xx}, 0, {xz}], [0, {yy}, 0], [0, 0, 1]]"
    return f"{harmonics}, + {bent}"


def _curve_names(table) -> list[str]:
    count = table.coefficients.shape[2]
    return list(table.metadata.get("fresnel_curve_names") or (f"curve {n}" for n in range(count)))


def _about(table, name) -> str:
    curves = "\n".join(f"    {number}: {text}" for number, text in enumerate(_curve_names(table)))
    return f"""\
{name}: {table.metadata.get("brdf", "a fitted BRDF")}, as linearly transformed lobes ({table.family}).
{_needs(identifier(name))} roughness^2 = alpha of GGX.
Fresnel curves of c, the cosine of the half angle; a reflectance that is a sum of them needs the same sum of integrals:
{curves}
Every function is explained where it stands; tables/EXPORT.md of LTSH has examples."""


def _about_sheen(name) -> str:
    return f"""\
{name}: the microfiber sheen of Cycles, a linearly transformed cosine (Zeltner, Burley and Chiang 2022).
{_needs(name)} The roughness is Blender's.
Every function is explained where it stands."""


def _needs(prefix) -> str:
    return f"""\
Needs C99 or C++; or GLSL 3.30, or GLSL ES 3.00 (WebGL 2) with `precision highp float; precision highp int;`; or HLSL of
shader model 5. In GLSL and HLSL define the macro {prefix.upper()}_DATA before, in WGSL the function {prefix}_data.
Made by `python -m tables export` of LTSH {VERSION}.
Frame: z is the shading normal, the view direction is (sin theta_o, 0, cos theta_o)."""
