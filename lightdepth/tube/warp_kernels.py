"""What NVIDIA Warp compiles for a GPU or a CPU: rays against a mesh. Imported only where Warp is wanted."""

# mypy: ignore-errors
# Annotations are Warp's own types and are read when a kernel is made: no postponed evaluation here.

import warp as wp


@wp.kernel
def first_hits(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    u: wp.array(dtype=wp.float32),
    v: wp.array(dtype=wp.float32),
):
    """Warp weighs a triangle's first and second corner; u and v are those of the second and third."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e6)
    face[i] = 0
    u[i] = 0.0
    v[i] = 0.0
    distance[i] = wp.inf
    if hit.result:
        distance[i] = hit.t
        face[i] = hit.face
        u[i] = hit.v
        v[i] = 1.0 - hit.u - hit.v


@wp.kernel
def any_hits(
    mesh: wp.uint64,
    start: wp.array(dtype=wp.vec3),
    end: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    reach = wp.length(end[i] - start[i])
    found[i] = 0
    if reach > 0.0:
        hit = wp.mesh_query_ray(mesh, start[i], (end[i] - start[i]) / reach, reach)
        if hit.result:
            found[i] = 1
