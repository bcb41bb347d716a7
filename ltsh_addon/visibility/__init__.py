"""The share of each light that is visible: occluders, rays through them, and what they leave of each light.

`occluders` holds what stands in the way. `starts` says where rays start, and `directions` chooses where they go. `rays`
traces them. `ratio` turns what they meet into shares (`visible_shares`), and `crew` does all of it on several cores.
"""

from __future__ import annotations

from .crew import Company, Mate, Setting
from .directions import shared_numbers
from .occluders import Hits, OccluderMesh, Occluders, Transparency
from .ratio import BLOCK_SAMPLES, ShadowSampling, Visibility, task_of_lights, visible_shares
from .rays import Tracer, open_tracer
from .starts import Starts

__all__ = [
    "BLOCK_SAMPLES",
    "Company",
    "Hits",
    "Mate",
    "OccluderMesh",
    "Occluders",
    "Setting",
    "ShadowSampling",
    "Starts",
    "Tracer",
    "Transparency",
    "Visibility",
    "open_tracer",
    "shared_numbers",
    "task_of_lights",
    "visible_shares",
]
