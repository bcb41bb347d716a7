void main()
{
    gl_Position = vec4(corner, @Z@, 1.0);
}
