"""Which share of a light is seen: occluders, rays through them, and what they leave of each light."""

from __future__ import annotations

from .occluders import OccluderMesh, Occluders, Transparency
from .ratio import Visibility, visible_shares
from .rays import Hits, Starts, Tracer, open_tracer

__all__ = [
    "Hits",
    "OccluderMesh",
    "Occluders",
    "Starts",
    "Tracer",
    "Transparency",
    "Visibility",
    "open_tracer",
    "visible_shares",
]
