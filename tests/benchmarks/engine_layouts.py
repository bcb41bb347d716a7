"""The errors in docs/engines.md: `python tests/benchmarks/engine_layouts.py [PUBLISHED [COMPRESSED]]`.

PUBLISHED is RectAreaLightTexturesLib.js of the npm package `three`, which has the tables of Heitz et al. 2016.
COMPRESSED is RectAreaLight.js of pull request 34611 of three.js, which compresses them. Errors are relative to the mean
of 400 rectangles, beside our `ltc` and beside a quadrature of GGX.
"""

import base64
import json
import re
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import engine_shaders  # noqa: E402
import textbook  # noqa: E402

from ltsh_addon import shading  # noqa: E402
from tables import layouts, pack  # noqa: E402

ORDER = 256  # Gauss points along each side of a rectangle: 384 change the errors by at most 0.01 %


def ggx_integrals(cosine, roughness, rectangles):
    """Integrals (P,) of GGX times cosine over rectangles, clipped at the horizon."""
    nodes, weights = np.polynomial.legendre.leggauss(ORDER)
    nodes, weights = 0.5 + 0.5 * nodes, 0.5 * weights
    values = []
    for mu, rough, corners in zip(cosine, roughness, rectangles, strict=True):
        first, second = corners[1] - corners[0], corners[3] - corners[0]
        points = corners[0] + nodes[:, None, None] * first + nodes[None, :, None] * second
        squared = (points**2).sum(axis=-1)
        directions = points / np.sqrt(squared)[..., None]
        height = directions[..., 2].copy()
        directions[height <= 0.0] = 0.0, 0.0, 1.0
        lobe = textbook.ggx_brdf(np.array([np.sqrt(1.0 - mu * mu), 0.0, mu]), directions, rough**2)
        solid_angle = np.abs(points @ np.cross(first, second)) / squared**1.5
        values.append(weights @ (lobe * np.maximum(height, 0.0) * solid_angle) @ weights)
    return np.array(values)


def published(path):
    """The two textures (2, 64, 64, 4) of a module of three.js."""
    texts = re.findall(r"LTC_MAT_\d = \[(.*?)\]", Path(path).read_text(encoding="utf-8"), re.DOTALL)
    return np.array([json.loads(f"[{text.replace('- ', '-')}]") for text in texts]).reshape(2, 64, 64, 4)


def compressed(path):
    """The two textures (2, 64, 64, 4) of three.js' compressed module, and how many bytes its numbers have.

    Its numbers are patches: a field, a rectangle of texels, counts of Chebyshev polynomials along both sides, an
    exponent; then the coefficients, whole numbers of 7 bits a byte, of alternating sign.
    """
    data = base64.b64decode("".join(re.findall(r"'([A-Za-z0-9+/=]{3,})'", Path(path).read_text(encoding="utf-8"))))
    fields, at = np.full((6, 64, 64), np.nan), 0
    while at < len(data):
        field, left, right, top, bottom, across, down, exponent = data[at : at + 8]
        at += 8
        coefficients = np.zeros(down * across)
        for index in range(len(coefficients)):
            code = shift = 0
            while True:
                code, shift, at = code | (data[at] & 127) << shift, shift + 7, at + 1
                if data[at - 1] < 128:
                    break
            coefficients[index] = -(code + 1) // 2 if code % 2 else code // 2
        rows, columns = (
            np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, count), degree - 1)
            for count, degree in ((bottom - top, down), (right - left, across))
        )
        scaled = np.ldexp(coefficients, exponent - 128).reshape(down, across)
        fields[field, top:bottom, left:right] = rows @ scaled @ columns.T
    length, angle, shear, height, magnitude, fresnel = fields
    alpha = np.maximum(np.linspace(0.0, 1.0, 64) ** 2, 1e-5)
    shear, height, cosine, sine = 2.0 * alpha * shear, 2.0 * alpha * height, np.cos(angle), np.sin(angle)
    inverse = length * cosine, shear * cosine - height * sine, length * sine, shear * sine + height * cosine
    zero = np.zeros_like(length)
    textures = np.stack([np.stack(inverse, -1), np.stack([magnitude.clip(0, 1), fresnel.clip(0, 1), zero, zero], -1)])
    return textures.astype(np.float16).astype(float), len(data)


def main(arguments):
    table = shading.load_table("ltc")
    cosine, roughness, corners = engine_shaders.random_rectangles()
    ours = shading.integrate_polygon(table, cosine, roughness, corners)
    truth = ggx_integrals(cosine, roughness, corners)
    albedo = table.albedos(cosine, roughness)[0].astype(float)

    def errors(values, expected):
        return [f"{100.0 * error:.2f} %" for error in engine_shaders.relative_errors(values, expected, corners)]

    print("our `ltc` itself beside GGX:", *errors(ours, truth))
    for name, layout in layouts.LAYOUTS.items():
        shader = engine_shaders.SHADERS[name]
        setting = (cosine, roughness, corners, *([albedo] if name == "unity" else []))
        textures = layouts.layout_textures(layout, table)
        # PlayCanvas converts to half floats.
        values = shader(textures.astype(np.float16) if name == "playcanvas" else textures, *setting)
        size = sum(map(len, layouts.layout_files(layout, table).values()))
        cells = [f"`{name}`", layout.engine, f"{size / 1000.0:.0f} kB", *errors(values, ours)[:2]]
        cells.append(errors(values, truth)[2])
        if arguments and len(layout.textures) == 2 and layout.unit == "w11":
            cells.append(errors(shader(published(arguments[0]), *setting), truth)[2])
        print(f"| {' | '.join(cells)} |")
    candidates = [("three.js, Heitz et al.", published(arguments[0]))] if arguments else []
    if len(arguments) > 1:
        textures, size = compressed(arguments[1])
        candidates.append((f"three.js, compressed ({size} bytes)", textures))
    for label, textures in candidates:
        for name in ("three", "bevy"):
            values = engine_shaders.SHADERS[name](textures, cosine, roughness, corners)
            print(f"{label} beside GGX, in the formula of {name}:", *errors(values, truth))
    packed = pack.load_pack()["ltc"]
    nodes = 2 * (packed.warp.size + packed.coefficients.size)
    values = shading.integrate_polygon(packed, cosine, roughness, corners)
    print(f"`ltc` of the pack ({nodes} bytes) beside GGX:", *errors(values, truth))
    exact = engine_shaders.unity(
        layouts.layout_textures(layouts.LAYOUTS["unity"], table), cosine, roughness, corners, albedo, exact_horizon=True
    )
    print("unity without its sphere:", *errors(exact, ours), "beside GGX:", *errors(exact, truth))


if __name__ == "__main__":
    main(sys.argv[1:])
