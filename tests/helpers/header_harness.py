"""Exported headers at work: tables to export, compiled with the C compiler, called through ctypes.

The GLSL branch is run too: with a vec3 and an atan of two arguments its text is C++ as well.
"""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ltsh_addon import shading
from ltsh_addon.lobes.edge_integrals import MAX_DEGREE
from ltsh_addon.lobes.lookup_table import LookupTable
from ltsh_addon.lobes.spherical_harmonics import coefficient_count
from tables import export as export_module
from tables import pack

C_COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
CXX_COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
WARNINGS = ["-Wall", "-Wextra", "-Werror", "-pedantic"]

# Shipped tables, and random ones by family and degree.
TABLES = {name: None for name in shading.SHIPPED_TABLES} | {
    f"random_{degree}": ("ltsh", degree) for degree in (1, 5, MAX_DEGREE)
}
TABLES["random_ltc"] = ("ltc", 1)
# Splines
TABLES |= {"pack_ltsh4": None, "pack_ltc": None}
# A compiler takes a second for each; two of the degrees between and an LTC of random matrices are for `make soak`.
NAMES = [
    pytest.param(name, marks=pytest.mark.soak) if name in ("ltsh2", "random_5", "random_ltc", "pack_ltc") else name
    for name in TABLES
]

_SHIM = """
#include <cmath>
#include <math.h>
#define LTSH_GLSL 1
struct vec3 { float x, y, z; };
static inline float atan(float y, float x) { return std::atan2(y, x); }
using std::sqrt;
extern "C" const float *storage;
const float *storage;
#define NAME_DATA(index) storage[index]
"""

_CALLS = """
#ifdef __cplusplus
extern "C" {
#endif

static ltsh_vec3 vector(const float *v) { return ltsh_make_vec3(v[0], v[1], v[2]); }

static ltsh_polygon polygon(int corners, const float *vertices)
{
    ltsh_polygon result = ltsh_empty_polygon();
    for (int i = 0; i < corners; ++i) { result = ltsh_with_corner(result, vector(vertices + 3 * i)); }
    return result;
}

int coefficient_count(void) { return UPPER_COEFFICIENTS; }

void lookup(int n, const float *cosine, const float *roughness, int curve, float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_cell cell = NAME_cell(cosine[i], roughness[i]);
        ltsh_warp warp = NAME_lookup_warp(cell);
        NAME_coefficients c = NAME_lookup_curve(cell, curve);
        float *row = out + i * (5 + UPPER_COEFFICIENTS);
        row[0] = warp.xx; row[1] = warp.xz; row[2] = warp.yy; row[3] = warp.zz; row[4] = warp.tilt;
        for (int k = 0; k < UPPER_COEFFICIENTS; ++k) { row[5 + k] = c.values[k]; }
    }
}

void dielectric(int n, const float *cosine, const float *roughness, const float *ior, float *out)
{
    for (int i = 0; i < n; ++i) {
        NAME_coefficients c = NAME_lookup_dielectric(NAME_cell(cosine[i], roughness[i]), ior[i]);
        for (int k = 0; k < UPPER_COEFFICIENTS; ++k) { out[i * UPPER_COEFFICIENTS + k] = c.values[k]; }
    }
}

void lobe(int n, const float *cosine, const float *roughness, const float *directions, float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_cell cell = NAME_cell(cosine[i], roughness[i]);
        out[i] = NAME_evaluate_lobe(NAME_lookup_warp(cell), NAME_lookup_curve(cell, 0), vector(directions + 3 * i));
    }
}

void integrate(int n, const float *cosine, const float *roughness, int corners, const float *vertices, float *out)
{
    for (int i = 0; i < n; ++i) {
        out[i] = NAME_integrate_polygon(cosine[i], roughness[i], polygon(corners, vertices + 3 * corners * i));
    }
}

void integral(int n, const float *cosine, const float *roughness, int curve, int corners, const float *vertices,
    float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_polygon visible = ltsh_clip_to_horizon(polygon(corners, vertices + 3 * corners * i));
        ltsh_cell cell = NAME_cell(cosine[i], roughness[i]);
        NAME_moments moments = NAME_polygon_moments(NAME_lookup_warp(cell), visible);
        out[i] = NAME_integral(NAME_moment_weights(NAME_lookup_curve(cell, curve)), moments);
    }
}

/* Of a rectangle, from a point with the normal (0, 0, 1). */
static ltsh_limits rectangle_limits(float cosine, float roughness, const float *v)
{
    ltsh_vec3 view = ltsh_make_vec3(sqrtf((1.0f - cosine) * (1.0f + cosine)), 0.0f, cosine);
    ltsh_vec3 normal = ltsh_make_vec3(0.0f, 0.0f, 1.0f);
    ltsh_vec3 zero = ltsh_make_vec3(0.0f, 0.0f, 0.0f);
    ltsh_vec3 first = ltsh_add_scaled(vector(v + 3), -1.0f, vector(v));
    ltsh_vec3 second = ltsh_add_scaled(vector(v + 6), -1.0f, vector(v + 3));
    ltsh_extent light;
    light.center = ltsh_add_scaled(ltsh_add_scaled(zero, 0.5f, vector(v)), 0.5f, vector(v + 6));
    light.half_u = ltsh_add_scaled(zero, 0.5f, first);
    light.half_v = ltsh_add_scaled(zero, 0.5f, second);
    light.area = ltsh_cross(first, second);
    if (ltsh_dot(light.area, light.center) > 0.0f) { light.area = ltsh_cross(second, first); }
    return ltsh_tail_limits(normal, normal, view, roughness, light);
}

void shaded(int n, const float *cosine, const float *roughness, const float *ior, int corners, const float *vertices,
    float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_polygon visible = ltsh_clip_to_horizon(polygon(corners, vertices + 3 * corners * i));
        float sign = ltsh_orientation(visible);
        ltsh_cell cell = NAME_cell(cosine[i], roughness[i]);
        NAME_moments moments = NAME_polygon_moments(NAME_lookup_warp(cell), visible);
        float plain = NAME_plain_integral(NAME_moment_weights(NAME_lookup_curve(cell, 0)), moments, sign);
        ltsh_limits limits = rectangle_limits(cosine[i], roughness[i], vertices + 3 * corners * i);
        int is_limited = UPPER_COEFFICIENTS > 1 && plain > 0.0f;
        plain = is_limited ? ltsh_between(plain, limits.least, limits.most) : plain;
        NAME_weights weights = NAME_moment_weights(NAME_lookup_dielectric(cell, ior[i]));
        float coat = NAME_dielectric_integral(weights, moments, sign, ior[i], plain);
        float most = is_limited ? ltsh_dielectric_reflectance(limits.cosine, ior[i]) * plain : 1e30f;
        out[2 * i] = plain;
        out[2 * i + 1] = ltsh_between(coat, 0.0f, most);
    }
}

void clip(int n, int corners, const float *vertices, int *count, float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_polygon visible = ltsh_clip_to_horizon(polygon(corners, vertices + 3 * corners * i));
        count[i] = visible.count;
        for (int k = 0; k < LTSH_MAX_CORNERS; ++k) {
            float *corner = out + 3 * (i * LTSH_MAX_CORNERS + k);
            corner[0] = visible.corners[k].x; corner[1] = visible.corners[k].y; corner[2] = visible.corners[k].z;
        }
    }
}

void form_factor(int n, int corners, const float *vertices, float *out)
{
    for (int i = 0; i < n; ++i) {
        out[i] = ltsh_form_factor(ltsh_clip_to_horizon(polygon(corners, vertices + 3 * corners * i)));
    }
}

void albedo(int n, const float *cosine, const float *roughness, int curve, float *out)
{
    for (int i = 0; i < n; ++i) { out[i] = NAME_albedo(NAME_cell(cosine[i], roughness[i]), curve); }
}

void average_albedo(int n, const float *roughness, int curve, float *out)
{
    for (int i = 0; i < n; ++i) { out[i] = NAME_average_albedo(roughness[i], curve); }
}

void fresnel(int n, const float *cosine, int curve, float *out)
{
    for (int i = 0; i < n; ++i) { out[i] = NAME_fresnel_curve(curve, cosine[i]); }
}

void local(int n, const float *normals, const float *views, const float *vectors, float *out)
{
    for (int i = 0; i < n; ++i) {
        ltsh_frame frame = ltsh_make_frame(vector(normals + 3 * i), vector(views + 3 * i));
        ltsh_vec3 v = ltsh_to_local(frame, vector(vectors + 3 * i));
        out[3 * i] = v.x; out[3 * i + 1] = v.y; out[3 * i + 2] = v.z;
    }
}

#ifdef __cplusplus
}
#endif
"""

_DATA_CALL = "\nconst float *data(void) { return NAME_data; }\n"


def synthetic_table(family: str, degree: int) -> LookupTable:
    """Random numbers on a grid that is not square, of a size at which the warp stays far from singular."""
    generator = np.random.default_rng(degree)
    rows, columns, curves, indices = 5, 7, 3, 4
    count = 1 if family == "ltc" else coefficient_count(degree)
    warp = generator.uniform(0.7, 1.3, (rows, columns, 4 if family == "ltc" else 3))
    if family == "ltc":
        warp[..., 3] = generator.uniform(-0.7, 0.7, (rows, columns))
    return LookupTable(
        name=f"{family}{degree}",
        family=family,
        degree=degree,
        warp=warp.astype(np.float32),
        coefficients=generator.normal(size=(rows, columns, curves, count)).astype(np.float32),
        fresnel_curves=generator.random((curves, 9)),
        fresnel_ior=np.array([1.0, 1.2, 1.7, 3.0]),
        fresnel_weights=generator.normal(size=(indices, curves)),
        average_albedo=generator.random((rows, curves)),
        metadata={"brdf": "a lobe */ of chance /* \u00e4 \\"},
    )


def export(folder: Path) -> dict[str, LookupTable]:
    """Write the header of every table into `folder`; the tables by name."""
    tables = {}
    for name, recipe in TABLES.items():
        if name.startswith("pack_"):
            tables[name] = pack.load_pack()[name.removeprefix("pack_")]
        else:
            tables[name] = synthetic_table(*recipe) if recipe else shading.load_table(name)
        export_module.export_table(tables[name], name, name, folder)
    return tables


class Header:
    """The functions of a compiled header on float32 arrays; results have one row per point."""

    def __init__(self, library: Path, data: np.ndarray | None = None):
        self._library = ctypes.CDLL(str(library))
        self._data = data
        if data is not None:  # the GLSL branch takes its numbers from outside
            ctypes.c_void_p.in_dll(self._library, "storage").value = data.ctypes.data
        self.coefficients = self._library.coefficient_count()

    def data(self, count: int) -> np.ndarray:
        self._library.data.restype = ctypes.POINTER(ctypes.c_float)
        return np.ctypeslib.as_array(self._library.data(), (count,)).copy()

    def call(self, name: str, *arguments, shape=()) -> np.ndarray:
        """`name`(n, arguments..., out): arrays become float pointers, integers stay; n is the length of the first."""
        arrays = [
            value if isinstance(value, int) else np.ascontiguousarray(value, dtype=np.float32) for value in arguments
        ]
        count = len(next(value for value in arrays if not isinstance(value, int)))
        out = np.full((count, *shape), np.nan, dtype=np.float32)
        pointers = [value if isinstance(value, int) else ctypes.c_void_p(value.ctypes.data) for value in arrays]
        getattr(self._library, name)(count, *pointers, ctypes.c_void_p(out.ctypes.data))
        return out

    def clip(self, vertices, room: int) -> list[np.ndarray]:
        """The corners of each clipped polygon."""
        vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        counts = np.zeros(len(vertices), dtype=np.int32)
        out = np.zeros((len(vertices), room, 3), dtype=np.float32)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (vertices, counts, out)]
        self._library.clip(len(vertices), vertices.shape[1], *pointers)
        return [corners[:count] for corners, count in zip(out, counts, strict=True)]


def compiled(header: Path, folder: Path, prefix: str) -> Header:
    """The header as C99, every warning an error."""
    return compiled_calls(header, folder, _named(_CALLS + _DATA_CALL, prefix))


def compiled_calls(header: Path, folder: Path, calls: str) -> Header:
    """The header as C99 with the functions of `calls` after it, every warning an error."""
    source = f'#include "{header}"\n{calls}'
    return Header(_build([C_COMPILER, "-std=c99", *WARNINGS], source, folder / f"{header.stem}.c"))


def compiled_glsl_branch(header: Path, folder: Path, prefix: str, data: np.ndarray) -> Header:
    """What a GLSL compiler sees of the header, as C++ with the data in an array given here."""
    source = f'{_SHIM.replace("NAME", prefix.upper())}\n#include "{header}"\n{_named(_CALLS, prefix)}'
    return Header(_build([CXX_COMPILER, "-std=c++11"], source, folder / f"{prefix}_glsl.cpp"), data)


def preprocessed(header: Path, *definitions: str) -> str:
    """What is left of the header when the preprocessor has run."""
    command = [C_COMPILER, "-E", "-P", *(f"-D{definition}" for definition in definitions), str(header)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout


def accepts(compiler: str, source: str, path: Path, *options: str) -> str:
    """What the compiler complains about: "" where it accepts the source."""
    path.write_text(source, encoding="ascii")
    command = [compiler, *options, *WARNINGS, "-fsyntax-only", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600).stderr


def _named(text: str, prefix: str) -> str:
    return text.replace("NAME", prefix).replace("UPPER", prefix.upper())


def _build(command, source: str, path: Path) -> Path:
    path.write_text(source, encoding="ascii")
    library = path.with_suffix(".so")
    done = subprocess.run(
        [*command, "-O0", "-shared", "-fPIC", str(path), "-o", str(library), "-lm"],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return library


def points(count: int, seed: int, lowest_roughness=0.0):
    """cos_theta_o and roughness, float32, some of them at the ends of the range."""
    generator = np.random.default_rng(seed)
    cosine, roughness = generator.random(count), lowest_roughness + (1.0 - lowest_roughness) * generator.random(count)
    cosine[:4], roughness[4:8] = (0.0, 1.0, 1e-3, 1.0 - 1e-6), (1.0, lowest_roughness, 1.0, lowest_roughness)
    return cosine.astype(np.float32), roughness.astype(np.float32)


def random_polygons(count: int, corners: int, seed: int) -> np.ndarray:
    """Planar convex polygons (count, corners, 3) of any winding, float32, about half of them cut by the horizon.

    Their planes keep a distance from the origin: else clipping makes edges that are half circles up to rounding, and no
    float32 formula knows their direction.
    """
    generator = np.random.default_rng(seed)
    tries = 4 * count
    center = generator.normal(size=(tries, 1, 3))
    center[..., 2] = generator.uniform(-0.3, 1.2, (tries, 1))
    angle = np.sort(generator.random((tries, corners)) * 2.0 * np.pi, axis=1)[..., None]
    first, second = generator.normal(size=(2, tries, 1, 3))
    normal = np.cross(first, second)[:, 0]
    distance = np.abs((normal * center[:, 0]).sum(axis=1)) / np.linalg.norm(normal, axis=1)
    polygons = center + np.cos(angle) * first + np.sin(angle) * second
    return polygons[distance > 0.2][:count].astype(np.float32)
