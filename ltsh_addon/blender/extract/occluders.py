"""temporary"""

import numpy as np
from ..evaluated import is_surface, read_values
from ...visibility import OccluderMesh, Occluders


def collect_occluders(depsgraph, override, warn):
    meshes, number, matrices = [], [], []
    for instance in depsgraph.object_instances:
        if not is_surface(instance):
            continue
        ob = instance.object
        mesh = ob.to_mesh()
        if mesh is None:
            continue
        mesh.calc_loop_triangles()
        n = len(mesh.loop_triangles)
        if n:
            v = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
            t = read_values(mesh.loop_triangles, "vertices", (n, 3), np.int32)
            number.append(len(meshes))
            meshes.append(OccluderMesh(v, t))
            matrices.append(np.array(instance.matrix_world, dtype=np.float64)[:3])
        ob.to_mesh_clear()
    return Occluders(tuple(meshes), np.array(number), np.array(matrices))
