"""The share of each light that is visible: occluders, rays through them, and what they leave of each light.

`occluders` holds what stands in the way. `starts` says where rays start, and `directions` chooses where they go. `rays`
traces them, and `ratio` turns what they meet into shares (`visible_shares`).
"""

from __future__ import annotations

from .directions import shared_numbers
from .occluders import Hits, OccluderMesh, Occluders, Transparency
from .ratio import BLOCK_SAMPLES, ShadowSampling, ShadowTask, Visibility, ray_origins, task_of_lights, visible_shares
from .rays import Tracer, open_tracer
from .starts import Starts

__all__ = [
    "BLOCK_SAMPLES",
    "Hits",
    "OccluderMesh",
    "Occluders",
    "ShadowSampling",
    "ShadowTask",
    "Starts",
    "Tracer",
    "Transparency",
    "Visibility",
    "open_tracer",
    "ray_origins",
    "shared_numbers",
    "task_of_lights",
    "visible_shares",
]
