#version 300 es
precision highp float;
in vec3 seen;
in vec3 hue;
uniform bool surface;
uniform float strength;
out vec4 color;
void main() {
  float light = surface ? 0.15 + 0.85 * abs(dot(normalize(cross(dFdx(seen), dFdy(seen))), normalize(seen))) : 1.0;
  color = vec4(hue * light, strength);
}
