void main() { color = texelFetch(picture, ivec2(gl_FragCoord.xy), 0); }
