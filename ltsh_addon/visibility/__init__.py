"""Which share of a light is seen: occluders, rays through them, and what they leave of each light."""

from __future__ import annotations

from .occluders import OccluderMesh, Occluders, Transparency
from .rays import Hits, Starts, Tracer, open_tracer

__all__ = ["Hits", "OccluderMesh", "Occluders", "Starts", "Tracer", "Transparency", "open_tracer"]
