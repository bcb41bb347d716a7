void main()
{
  vec4 world = model * vec4(position, 1.0);
  v_position = world.xyz;
  v_normal = transpose(inverse(mat3(model))) * normal;
  /* Cycles transforms meshes with one user to world space, and normalizes their normals there. */
  v_normal /= ONLY_USER ? max(length(v_normal), 1e-30) : 1.0;
  v_object_normal = normal;
  v_uv = uv;
  v_tangent = tangent;
#ifdef DRAWS_TANGENTS
  v_around = around;
#endif
  gl_Position = view.projection * world;
}
