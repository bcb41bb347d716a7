void main()
{
    gl_FragDepth = texelFetch(positions, ivec2(gl_FragCoord.xy), 0).w > 0.0 ? 1.0 : 0.0;
}
