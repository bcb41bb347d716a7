"""Materials and worlds as the viewport shows them."""

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ...cycles.lobes import BRUSHED_KINDS, SMALLEST_WEIGHT, aspect_of
from ..render_settings import cycles_setting
from . import graph
from .bsdfs import REFRACTION_NODE, SHOWN_RIGHT, Bsdf, bsdf_of, emission_sockets, has_alpha, is_emission, lobe_notes
from .values import GRAY, ImageUse, Value, colors_at, constant, constant_inputs, input_value, is_gray, value_at

# Quantities that may come from an image; all others are constants.
IMAGE_SLOTS = ("color", "roughness", "metallic", "ior", "normal", "weight")
# NEUTRAL: the value of each quantity of a `PreviewMaterial` that is left out.
NEUTRAL = {"color": 0.8, "roughness": 1.0, "metallic": 0.0, "ior": 1.5, "specular_level": 0.5, "tint": 1.0,
           "transmission": 0.0, "weight": 1.0, "diffuse_roughness": 0.0}  # fmt: skip
# METALS, SMOOTH: kinds that reflect all light in their direction, and the roughness below which they are mirrors.
METALS, SMOOTH = ("glossy", "metal", "conductor", "conductor_4_5"), 0.3
# ROUGH_KINDS: kinds whose diffuse part may be rough.
ROUGH_KINDS = ("principled", "diffuse")
# Kinds beside those of `cycles.lobes.LOBE_KINDS`. COAT: of another lobe. REFRACTION and FILTER: what only lets light
# through, which crosses both sides of a body, or one surface.
COAT, REFRACTION, FILTER = OTHER_KINDS = ("coat", "refraction", "filter")
CLEAREST = 0.999  # the color from which on a surface that lets light through is not drawn


@dataclass(frozen=True)
class Coat:
    """The coat over the lobe of a Principled BSDF; all values are constant."""

    weight: float
    roughness: float
    ior: float
    tint: np.ndarray  # (3,)
    follows_normal: bool  # it has the normal map of the lobe; otherwise none


@dataclass(frozen=True)
class ViewFactor:
    """The output of a Fresnel or Layer Weight node, by the cosine c between the view and the smooth normal."""

    kind: str  # "fresnel": reflectance of a dielectric; "facing": 1 - c^parameter
    parameter: float  # of "fresnel": the index of refraction
    is_complement: bool = False  # the factor is 1 minus the output

    @classmethod
    def of(cls, kind: str, parameter: float, is_blend: bool = False) -> "ViewFactor":
        """From the node's number: an index of refraction, or the Blend of a Layer Weight node."""
        if not is_blend:
            return cls(kind, max(parameter, 1e-5))
        if kind == "fresnel":
            return cls(kind, 1.0 / max(1.0 - parameter, 1e-5))
        blend = float(np.clip(parameter, 0.0, 1.0 - 1e-5))
        return cls(kind, 2.0 * blend if blend < 0.5 else 0.5 / (1.0 - blend))

    def complement(self) -> "ViewFactor":
        """1 minus this."""
        return replace(self, is_complement=not self.is_complement)


@dataclass(frozen=True)
class Brush:
    """The shape and direction of an anisotropic lobe."""

    aspect: float  # see `cycles.lobes.aspect_of`
    rotation: float  # of the tangent, in turns
    direction: str  # X, Y or Z: around the object's axis; "": along u of a UV map
    uv_map: str = ""


@dataclass(frozen=True)
class PreviewMaterial:
    """One lobe of a material in the viewport. The first lobe also holds the other lobes, emission and notes."""

    kind: str  # of `cycles.lobes.LOBE_KINDS` or OTHER_KINDS
    values: dict[str, Value]  # by the names of NEUTRAL
    normal: Value | None = None  # of a tangent space normal map
    normal_strength: float = 1.0
    scattered: bool = False  # Multiscatter GGX
    corrected: bool = True  # Cycles bends specular normals toward the eye
    weight: float = 1.0
    view_factor: ViewFactor | None = None  # multiplies the weight
    coat: Coat | None = None  # the coat over this lobe; for the kind COAT the coat that it is
    brush: Brush | None = None  # None: isotropic
    # Sheen over the lobe and its coat: its largest weight over the colors, and its roughness.
    sheen: tuple[float, float] | None = None
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    emission_image: Value | None = None  # what shines beside reflecting, by an image; it is added to `emission`
    glow: float = 0.0  # strength of a material that only emits, by the image of its color
    notes: tuple[str, ...] = ()
    light_notes: tuple[str, ...] = ()  # those of `notes` about the light that it casts
    further: "tuple[PreviewMaterial, ...]" = ()  # lobes that are added to this one
    is_clear: bool = False  # nothing is drawn
    is_stand_in: bool = False  # it stands for a node that reflects nothing, or is not shaded

    @property
    def lobes(self) -> "tuple[PreviewMaterial, ...]":
        """This lobe and the further ones."""
        return (self, *self.further)

    def value(self, name: str) -> Value:
        """The quantity `name`, or its neutral value."""
        return self.values.get(name) or constant(NEUTRAL[name])

    @property
    def through(self) -> float:
        """The share of the lobe, apart from metal, that lets the view through."""
        if self.kind in ("glass", REFRACTION, FILTER):
            return 1.0
        return float(np.clip(self.value("transmission").offset[0], 0.0, 1.0)) if self.kind == "principled" else 0.0

    @property
    def is_of_cycles(self) -> bool:
        """True if a view with bounces shows it whole as Cycles does: what shines, glass, and what is not resolved."""
        shines = self.glow > 0.0 or bool(np.any(self.emission)) or self.emission_image is not None
        return not self.is_clear and (shines or bool(self.notes) or any(lobe.through > 0.0 for lobe in self.lobes))

    @property
    def shining_image(self) -> Value | None:
        """The image by which it shines: times `glow` if it only shines, else beside `emission`."""
        return self.value("color") if self.glow else self.emission_image

    def notes_in_view(self, with_bounces: bool) -> tuple[str, ...]:
        """What views do not show of it as Cycles does. With bounces that is the light that it casts alone."""
        return self.light_notes if with_bounces else self.notes

    @property
    def is_mirror(self) -> bool:
        """True for smooth metal, which shows what is around it."""
        is_metal = self.kind in METALS or (self.kind == "principled" and self.value("metallic").offset[0] > 0.5)
        roughness = self.value("roughness")
        return is_metal and roughness.is_constant and bool(roughness.offset[0] < SMOOTH)

    @property
    def is_bent(self) -> bool:
        """True if its index of refraction may be below 1, which allows total reflection."""
        ior = self.value("ior")
        return self.kind == "glass" or not (ior.is_constant and ior.offset[0] >= 1.0)

    @property
    def is_rough(self) -> bool:
        """True if its diffuse part is rough."""
        return self.kind in ROUGH_KINDS and self.value("diffuse_roughness").offset[0] > 0.0

    @property
    def images(self) -> dict[str, ImageUse]:
        """Its images, by slot of IMAGE_SLOTS."""
        images = {name: value.image for name, value in self.values.items() if name in IMAGE_SLOTS and value.image}
        return {**images, "normal": self.normal.image} if self.normal is not None else images

    @property
    def uv_map(self) -> str:
        """The UV map of its images and its tangent ("": the one that renders)."""
        return next((use.uv_map for use in self.images.values()), "" if self.brush is None else self.brush.uv_map)

    @property
    def has_uv_tangent(self) -> bool:
        """True if it needs tangents along its UV map."""
        return self.normal is not None or (self.brush is not None and not self.brush.direction)


def is_missing(image) -> bool:
    """True for images without pixels: their file is missing or unreadable."""
    return not all(image.size)


def plain_preview(color) -> PreviewMaterial:
    """A diffuse surface."""
    return PreviewMaterial("diffuse", {"color": constant(color)})


def default_preview() -> PreviewMaterial:
    """The preview of a surface without material in Cycles: gray, from 5.0 on with the defaults of a Principled BSDF."""
    if bpy.app.version < (5, 0, 0):
        return plain_preview(0.8)
    return PreviewMaterial("principled", {"color": constant(0.8), "roughness": constant(0.5)})


# Quantity of `cycles.lobes.LOBE_AOVS` -> viewport setting of the material that replaces an unknown value.
STAND_INS = {"color": "diffuse_color", "roughness": "roughness", "metallic": "metallic"}
# Nodes whose value depends on the view. The outputs of Layer Weight have the names of the kinds of `ViewFactor`.
VIEW_FACTORS = ("ShaderNodeFresnel", "ShaderNodeLayerWeight")
# MOST_LOBES: of one material; each costs the same.
MOST_LOBES = 8


def preview_of(material) -> PreviewMaterial:
    """How the viewport shades `material`."""
    if material is None:
        return default_preview()
    if bpy.app.version < (5, 0, 0) and not material.use_nodes:
        return plain_preview(material.diffuse_color)
    surface = graph.surface_of(material)
    if surface is None:
        return plain_preview(0.0)
    shaders = graph.shaders_behind(surface)
    look = _PreviewReader(material, shaders).look()
    lost = ["volume is not shown"] if graph.live_link(surface.node.inputs["Volume"]) is not None else []
    if graph.has_displacement(material):
        height = graph.displacement_height(material)
        size = "" if height is None else f", by up to {height:.3g} m,"
        lost.append(f"displacement{size} is not shown: its light is 10 to 50 % off")
    notes = (*look.notes, *(f"{material.name}: its {text}" for text in lost))
    is_clear = graph.is_seen_through(surface.node, shaders) and all(map(_is_clear, look.lobes))
    return replace(look, notes=notes, is_clear=is_clear)


def _is_clear(lobe: PreviewMaterial) -> bool:
    """True for lobes that change no light: a black stand-in for a surface without any, or a white filter."""
    color = lobe.value("color")
    return lobe.kind != FILTER or (color.is_constant and bool(np.min(color.offset) >= CLEAREST))


@dataclass(frozen=True)
class LobeWeight:
    """The share of a node in a material: a constant, perhaps times an image, perhaps times a function of the view."""

    constant: float = 1.0
    image: Value | None = None
    curve: ViewFactor | None = None
    shining: float = 1.0  # the approximate mean share of its emission, which transparency reduces, too

    @property
    def estimate(self) -> float:
        """A rough estimate of its mean: images and functions of the view count as one half."""
        return self.constant * 0.5 ** ((self.image is not None) + (self.curve is not None))

    @property
    def values(self) -> dict[str, Value]:
        """Its image as the quantity "weight" of a `PreviewMaterial`; {} without one."""
        return {} if self.image is None else {"weight": self.image}

    def times(self, factor: Value | ViewFactor | None) -> "LobeWeight | None":
        """This share times `factor`; None if the product cannot be expressed."""
        if isinstance(factor, ViewFactor) and self.curve is None:
            return replace(self, curve=factor, shining=0.5 * self.shining)
        if not isinstance(factor, Value):
            return None
        if factor.is_constant:
            weight = float(np.clip(factor.offset[0], 0.0, 1.0))
            return replace(self, constant=self.constant * weight, shining=self.shining * weight)
        return replace(self, image=factor, shining=0.5 * self.shining) if self.image is None else None


def _value_of_factor(factor: graph.Factor) -> Value | ViewFactor | None:
    """The factor as a value; None: unknown."""
    value = value_at(factor.node.inputs[0], factor.groups)
    if value is None:
        value = _view_factor(factor.source)
    if value is None or not factor.is_complement:
        return value
    if isinstance(value, ViewFactor):
        return value.complement()
    return constant(1.0 - np.clip(value.offset, 0.0, 1.0)) if value.is_constant else value.mapped(-np.eye(3), 1.0)


def _view_factor(source: graph.Source | None) -> ViewFactor | None:
    """The output of a Fresnel or Layer Weight node with a constant number and the smooth normal; None for others."""
    if source is None or source.node is None or source.node.bl_idname not in VIEW_FACTORS:
        return None
    normal, parameter = source.input("Normal"), constant_inputs(source, 0)
    if normal is None or normal.node is not None or parameter is None:
        return None
    is_blend = source.node.bl_idname == "ShaderNodeLayerWeight"
    kind = source.socket.name.lower() if is_blend else "fresnel"
    return ViewFactor.of(kind, float(parameter[0][0]), is_blend)


class _PreviewReader:
    """Makes the preview of a material from its leaves."""

    def __init__(self, material, shaders: graph.SurfaceShaders):
        self.material, self.notes, self.light_notes, self.emission_image = material, [], [], None
        drawn = [leaf for leaf in shaders.leaves if not leaf.is_transparent]
        if shaders.is_transparent:
            drawn = [leaf for leaf in shaders.leaves if leaf.node.bl_idname == graph.CLEAR]
        pairs = [(leaf, share) for leaf in drawn for share in self._shares(leaf)]
        guesses, self.notes = self.notes, []
        self.emitters = [(leaf.source, share) for leaf, share in pairs if is_emission(leaf.node)]
        self.leaves = [(leaf.source, share) for leaf, share in pairs if not is_emission(leaf.node)]
        has_clear = shaders.cuts or any(leaf.is_transparent for leaf in shaders.leaves)
        if (self.leaves or self.emitters) and has_clear and not shaders.is_transparent:
            opaque = sum(share.shining for _, share in pairs) / sum(share.estimate for _, share in pairs)
            self.note(f"transparency of about {100.0 * (1.0 - min(opaque, 1.0)):.0f} % is not shown")
        for leaf in shaders.leaves:
            if has_alpha(leaf.node) and not leaf.is_transparent:
                alpha = constant_inputs(leaf.source, "Alpha")
                size = "that varies" if alpha is None else f"of {float(alpha[0][0]):.2g}"
                self.note(f"alpha {size} is not shown, the surface is opaque")
        self.notes += guesses

    def note_light(self, message: str) -> None:
        """Take a note about the light that it casts."""
        self.note(message)
        self.light_notes.append(self.notes[-1])

    def note(self, message: str) -> None:
        """Note a difference between the material and what the viewport shows."""
        self.notes.append(f"{self.material.name}: {message}")

    def _shares(self, leaf: graph.WeightedShader) -> list[LobeWeight]:
        """The shares of `leaf` that are not 0: one per term, but terms that differ only in their constants are added.

        Unknown factors count as one half.
        """
        shares = []
        for term in leaf.terms:
            share = LobeWeight()
            for factor in term:
                share = self._with_factor(share, factor)
            same = next((other for other in shares if other.image is share.image and other.curve == share.curve), None)
            if same is not None:
                shares.remove(same)
                both = {"constant": same.constant + share.constant, "shining": same.shining + share.shining}
                share = replace(share, **both)
            shares.append(share)
        return [share for share in shares if share.estimate > 0.0]

    def _with_factor(self, share: LobeWeight, factor: graph.Factor) -> LobeWeight:
        whole = share.times(_value_of_factor(factor))
        if whole is None:
            self.note(f"factor of {factor.node.name!r} is not resolved, half of each side is shown")
            whole = share.times(constant(0.5))
        return replace(share, shining=whole.shining) if factor.beside_transparency else whole

    def look(self) -> PreviewMaterial:
        """The preview: the lobe with the largest estimated share, with the others in `further`."""
        glow = self._glow()
        if glow is not None:
            return glow
        emission = np.zeros(3)
        for source, share in self.emitters:
            emission = emission + self._shining(share, self._emission(source, share))
        lobes: list[PreviewMaterial] = []
        for source, share in sorted(self.leaves, key=lambda pair: -pair[1].estimate):
            emission = emission + self._shining(share, self._emission(source, share))
            lobes += self._lobes_of(source, share)
        if not lobes:
            lobes = [plain_preview(0.0)]
        if len(lobes) > MOST_LOBES:
            self.note(f"of its {len(lobes)} lobes only {MOST_LOBES} are shown")
        first, *further = lobes[:MOST_LOBES]
        shining = {"emission": emission, "emission_image": self.emission_image}
        return replace(first, **shining, further=tuple(further), **self._all_notes())

    def _glow(self) -> PreviewMaterial | None:
        """The preview of a material that only emits an image, like a baked texture; None for other materials."""
        if self.leaves or len(self.emitters) != 1:
            return None
        source, share = self.emitters[0]
        color, strength = (value_at(socket, source.groups) for socket in emission_sockets(source.node))
        if color is None or color.image is None or strength is None or not strength.is_constant:
            return None
        if share.image is not None or share.curve is not None:
            return None
        glow = share.shining * float(strength.offset[0])
        return PreviewMaterial("diffuse", {"color": color}, weight=0.0, glow=glow, **self._all_notes())

    def _all_notes(self) -> dict[str, tuple[str, ...]]:
        return {name: tuple(dict.fromkeys(getattr(self, name))) for name in ("notes", "light_notes")}

    def _shining(self, share: LobeWeight, emission: np.ndarray) -> np.ndarray:
        if emission.any() and (share.image is not None or share.curve is not None):
            self.note_light("its emission varies: half of it is shown")
        return share.shining * emission

    def _lobes_of(self, source: graph.Source, share: LobeWeight) -> list[PreviewMaterial]:
        """The lobes of one BSDF node."""
        bsdf = bsdf_of(source.node)
        kind = {REFRACTION_NODE: REFRACTION, graph.CLEAR: FILTER}.get(source.node.bl_idname, "diffuse")
        if bsdf is None:
            if kind == "diffuse":
                self.note(f"{source.node.bl_label} is not shown, its viewport color is")
                color = constant(self.material.diffuse_color)
            else:
                color = self._value(source, "color", "Color")
            values = self._on_one_uv_map({"color": color, **share.values})
            return [PreviewMaterial(kind, values, weight=share.constant, view_factor=share.curve, is_stand_in=True)]
        look = self._lobe(source, bsdf, share)
        fuzz = self._sheen(source, look) if look.kind == "principled" else []
        coat = self._coat(source, look) if look.kind == "principled" else None
        if fuzz:
            tint, roughness = (fuzz[0].value(name).offset for name in ("color", "roughness"))
            look = replace(look, sheen=(float(np.max(tint)), float(np.max(roughness))))
        if coat is None:
            return [look, *fuzz]
        look = replace(look, coat=coat)
        values = {"roughness": constant(coat.roughness), "ior": constant(coat.ior), "weight": look.value("weight")}
        # A coat always has multiple scattering.
        shine = replace(look, kind=COAT, values=values, scattered=True, brush=None)
        return [look, shine if coat.follows_normal else replace(shine, normal=None), *fuzz]

    def _lobe(self, source: graph.Source, bsdf: Bsdf, share: LobeWeight) -> PreviewMaterial:
        node, names = source.node, bsdf.sockets
        values = {name: self._value(source, name, names[name]) for name in NEUTRAL if name in names}
        values = self._on_one_uv_map({**values, **share.values})
        if bsdf.roughness_factor != 1.0:
            values["roughness"] = values["roughness"].mapped(bsdf.roughness_factor * np.eye(3))
        for note in lobe_notes(node, bsdf, lambda name, value: _is_at(source, name, value)):
            if not note.endswith(SHOWN_RIGHT):
                self.note(note)
        normal, strength = self._normal(source, values)
        corrected = cycles_setting(self.material, "use_bump_map_correction")
        look = PreviewMaterial(
            bsdf.kind, values, normal, strength, bsdf.is_scattered, corrected, share.constant, share.curve
        )
        look = replace(look, brush=self._brush(source, bsdf, look))
        for name in dict.fromkeys(use.image.name for use in look.images.values() if is_missing(use.image)):
            self.note(f"image {name!r} is missing, it is pink")
        return look

    def _brush(self, source: graph.Source, bsdf: Bsdf, look: PreviewMaterial) -> Brush | None:
        """The `Brush` of the lobe `look` of the node at `source`; None if it is isotropic."""
        if "anisotropy" not in bsdf.sockets or bsdf.kind not in BRUSHED_KINDS:
            return None
        anisotropy = constant_inputs(source, bsdf.sockets["anisotropy"])
        aspect = 1.0 if anisotropy is None else float(aspect_of(bsdf.kind, anisotropy[0][0]))
        if anisotropy is not None and aspect == 1.0:
            return None
        rotation, tangent = constant_inputs(source, bsdf.sockets["rotation"]), source.input("Tangent")
        direction, uv_map = _direction_of(None if tangent is None else tangent.node)
        other_maps = {use.uv_map for use in look.images.values()} - {"", uv_map}
        if anisotropy is None or rotation is None or direction is None or (uv_map and not direction and other_maps):
            self.note("its anisotropy is not resolved, it is shown without")
            return None
        return Brush(aspect, float(rotation[0][0]), direction, uv_map)

    def _sheen(self, source: graph.Source, look: PreviewMaterial) -> list[PreviewMaterial]:
        """The sheen lobe of a Principled BSDF; [] without sheen."""
        weight, roughness, tint = (
            np.maximum(self._value(source, "", f"Sheen {name}").offset, 0.0) for name in ("Weight", "Roughness", "Tint")
        )
        color = np.max(weight) * tint * np.ones(3)
        if np.max(color) <= SMALLEST_WEIGHT:
            return []
        values = {"color": constant(color), "roughness": constant(min(float(np.max(roughness)), 1.0))}
        values["weight"] = look.value("weight")
        return [replace(look, kind="sheen", values=values, scattered=False, brush=None)]

    def _coat(self, source: graph.Source, look: PreviewMaterial) -> Coat | None:
        """The coat of a Principled BSDF, or None."""
        weight = float(self._value(source, "", "Coat Weight").offset[0])
        if weight <= SMALLEST_WEIGHT:
            return None
        sockets = ("Coat Roughness", "Coat IOR", "Coat Tint")
        roughness, ior, tint = (self._value(source, "", name).offset for name in sockets)
        normal, follows = source.input("Coat Normal"), False
        if normal is not None and normal.node is not None:
            lobe_normal = source.input("Normal")
            follows = look.normal is not None and (lobe_normal.node, lobe_normal.groups) == (normal.node, normal.groups)
            if not follows:
                self.note("Coat Normal is not resolved, the coat is smooth")
        roughness, ior = float(np.clip(roughness[0], 0.0, 1.0)), max(float(ior[0]), 1.0)
        return Coat(weight, roughness, ior, np.maximum(tint, 0.0) * np.ones(3), follows)

    def _value(self, source: graph.Source, name: str, socket_name: str) -> Value:
        value = input_value(source, socket_name)
        if value is not None and (value.is_constant or name in IMAGE_SLOTS):
            return value
        shown = source.node.inputs[socket_name].default_value if value is None else value.offset
        shown = constant(getattr(self.material, STAND_INS[name]) if name in STAND_INS else shown)
        numbers = np.unique(shown.offset.round(3)) if is_gray(shown) else shown.offset
        self.note(f"{socket_name} is not resolved, {' '.join(f'{one:.2g}' for one in numbers)} is shown")
        return shown

    def _on_one_uv_map(self, values: dict[str, Value]) -> dict[str, Value]:
        """`values`, where images on other UV maps than the first image are replaced by constants."""
        first, result = None, {}
        for name, value in values.items():
            if value.image is not None:
                first = value.image.uv_map if first is None else first
                if value.image.uv_map != first:
                    self.note(f"the image of {name} is on another UV map and not shown")
                    value = constant(getattr(self.material, STAND_INS[name]) if name in STAND_INS else NEUTRAL[name])
            result[name] = value
        return result

    def _normal(self, source: graph.Source, values: dict[str, Value]) -> tuple[Value | None, float]:
        """The normal map at the Normal socket, or None, and its strength."""
        normal = source.input("Normal") if "Normal" in source.node.inputs else None
        if normal is None or normal.node is None:
            return None, 1.0
        node, color, strength, maps = normal.node, None, None, set()
        if node.bl_idname == "ShaderNodeNormalMap" and node.space == "TANGENT":
            color, strength = input_value(normal, "Color"), constant_inputs(normal, "Strength")
            maps = {value.image.uv_map for value in values.values() if value.image is not None} | {node.uv_map}
        if color is None or strength is None or len(maps - {""}) > 1:
            self.note(f"normals from {node.name!r} are not resolved, the surface is smooth")
            return None, 1.0
        if color.image is None:
            return None, 1.0
        return color, float(strength[0][0])

    def _emission(self, source: graph.Source, share: LobeWeight) -> np.ndarray:
        """The emission (3,) of a node, of one that varies about the mean; that of an image is `emission_image`."""
        sockets = emission_sockets(source.node)
        values = [value_at(socket, source.groups) for socket in sockets]
        known = [value.offset for value in values if value is not None and value.is_constant]
        whole = np.prod(known, axis=0) * np.ones(3) if known else np.zeros(3)
        if len(known) == len(values) or (known and not whole.any()):
            return whole
        color, strength = (colors_at(socket, source.groups) for socket in sockets)
        is_plain = self.emission_image is None and share.image is None and share.curve is None
        if is_plain and values[0] is not None and values[0].image is not None and known:
            self.note("the image of its emission is shown as its mean")
            self.emission_image = values[0].mapped(share.shining * whole * np.eye(3))
            return np.zeros(3)
        if strength is None:
            self.note_light("the strength of its emission varies: it is not shown and lights nothing")
            return np.zeros(3)
        if color is None:
            self.note_light("the color of its emission varies: half of its strength is shown, at most as much off")
            return 0.5 * strength.mean(axis=0)
        product = (color[:, None] * (strength @ GRAY)[:, None]).reshape(-1, 3)
        mean = product.mean(axis=0)
        off = 100.0 * np.abs(product - mean).sum(axis=-1).mean() / max(mean.sum(), 1e-30)
        if off > 0.0:
            self.note_light(f"its emission varies: it shines as about the mean of its colors, {off:.0f} % off them")
        return mean


def _is_at(source: graph.Source, name: str, value: float) -> bool:
    """True if the input `name` of a node is the constant `value`."""
    given = constant_inputs(source, name)
    return given is not None and bool(np.all(given[0] == value))


def _direction_of(node) -> tuple[str | None, str]:
    """`direction` and `uv_map` of a `Brush` whose tangent comes from `node`; (None, "") for unknown tangents."""
    if node is None or node.bl_idname == "ShaderNodeNewGeometry":
        return "Z", ""
    if node.bl_idname != "ShaderNodeTangent":
        return None, ""
    return (node.axis, "") if node.direction_type == "RADIAL" else ("", node.uv_map)


def world_radiance(world) -> tuple[np.ndarray, bool]:
    """Radiance (3,) of the background in W m^-2 sr^-1, and whether it is exact.

    It is exact for a world of one constant Background node or without nodes. For others it is the viewport color.
    """
    if world is None:
        return np.zeros(3), True
    if graph.tree_in_use(world) is None:
        return np.array(world.color, np.float64), True
    surface = graph.surface_of(world)
    source = graph.source_of(surface) if surface is not None else None
    if source is None or source.node is None:
        return np.zeros(3), True
    if source.node.bl_idname == "ShaderNodeBackground":
        parts = constant_inputs(source, "Color", "Strength")
        if parts is not None:
            return parts[0] * parts[1], True
    return np.array(world.color, np.float64), False
