#version 300 es
// Lines of cameras and paths, and the surface.
precision highp float;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 tint;
uniform mat4 view;
uniform vec4 K;
uniform vec2 size;
uniform float near;
uniform float far;
out vec3 seen;
out vec3 hue;
void main() {
  seen = (view * vec4(position, 1.0)).xyz;
  hue = tint;
  vec2 ndc = vec2(2.0 * (K.x * seen.x + K.z * seen.z) / size.x - seen.z,
    seen.z - 2.0 * (K.y * seen.y + K.w * seen.z) / size.y);
  gl_Position = vec4(ndc, (far + near) / (far - near) * seen.z - 2.0 * far * near / (far - near), seen.z);
}
