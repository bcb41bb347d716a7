"""Samples sorted by what their Fresnel factors need: fewer terms are cheaper."""

from __future__ import annotations

import numpy as np

# With more different indices of refraction in a block the dielectric's weights are summed up per sample.
SEPARATE_IORS = 8


def any_component(vectors):
    """Mask (P,) of the vectors (P, 3) with an element that is not 0; numpy's own reduction of short rows is slow."""
    return (vectors[:, 0] != 0) | (vectors[:, 1] != 0) | (vectors[:, 2] != 0)


def columns(vectors, index):
    """Rows `index` of vectors (P, 3) as (3, Q) float32."""
    return np.ascontiguousarray(vectors[index].T, dtype=np.float32)


def fresnel_kinds(samples, members):
    """Yield (vectors, members, colors): what part of the Fresnel terms the samples `members` need.

    `vectors` as in `ridge_table.RidgeTable`, colors(index) (F, 3, Q) their reflectances.
    """
    dipped = any_component(samples.specular_dip)[members]
    metal = (any_component(samples.specular_f90) | any_component(samples.specular_f0))[members] | dipped
    flat = ~any_component(samples.specular_f90 != samples.specular_f0)[members] & ~dipped
    dielectric = any_component(samples.dielectric)[members]

    def white(index):
        return columns(samples.specular_f0, index)[None]

    def schlick(index):
        f0 = columns(samples.specular_f0, index)
        return np.stack([f0, columns(samples.specular_f90, index) - f0])

    def f82(index):
        return np.concatenate([schlick(index), -columns(samples.specular_dip, index)[None]])

    def coat(index):
        return columns(samples.dielectric, index)[None]

    yield (0,), members[~dielectric & flat], white
    yield (0, 1), members[~dielectric & ~flat & ~dipped], schlick
    yield (0, 1, 2), members[~dielectric & dipped], f82
    for vector, with_ior in _by_ior(samples.ior, members[dielectric & ~metal]):
        yield (vector,), with_ior, coat
    for own, chosen in (((0, 1), metal & ~dipped), ((0, 1, 2), dipped)):
        first = f82 if 2 in own else schlick
        for vector, with_ior in _by_ior(samples.ior, members[dielectric & chosen]):
            yield (*own, vector), with_ior, lambda index, first=first: np.concatenate([first(index), coat(index)])


def _by_ior(ior, members):
    """Yield (vector, members): the dielectric's weight vector, one per index of refraction where there are few."""
    values = ior[members]
    if len(members) == 0:
        return
    if values.min() == values.max():
        yield ("dielectric", float(values[0])), members
        return
    distinct, number = np.unique(values, return_inverse=True)
    if len(distinct) > SEPARATE_IORS:
        yield "dielectric", members
        return
    for position, value in enumerate(distinct):
        yield ("dielectric", float(value)), members[number == position]
