"""The share of each light that is visible: occluders, rays through them, and what they leave of each light.

`occluders` holds what stands in the way. `shadow_terminator` says where rays start, and `ray_sampler` chooses where
they go. `rays` traces them, and `ratio` turns what they meet into the visibility of lights (`trace_visibility`).
"""

from .light_cluster import shared_numbers
from .occluders import Hits, OccluderMesh, Occluders, Transparency
from .ratio import ShadowSampling, Visibility, trace_ray_origins, trace_visibility
from .rays import Tracer, open_tracer
from .shadow_terminator import RayOrigins
