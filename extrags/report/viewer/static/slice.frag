#version 300 es
// Clearance on a plane across the view; nothing where space is not free.
precision highp float;
precision highp sampler3D;
uniform sampler3D table;
uniform mat3 turn;
uniform vec3 shift;
uniform vec4 K;
uniform vec2 size;
uniform float depth;
uniform float least;           // level half way between the outermost free voxels and those beside them
out vec4 color;

const float LINES = 8.0;

vec3 ramp(float t) {
  return t < 0.5 ? mix(vec3(0.17, 0.09, 0.38), vec3(0.10, 0.56, 0.55), 2.0 * t)
    : mix(vec3(0.10, 0.56, 0.55), vec3(0.99, 0.91, 0.45), 2.0 * t - 1.0);
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec3 place = turn * vec3(depth * (pixel - K.zw) / K.xy, depth) + shift;
  if (any(lessThan(place, vec3(0.0))) || any(greaterThan(place, vec3(1.0)))) discard;
  float level = texture(table, place).r * 255.0;
  if (level < least) discard;
  float share = clamp((level - 2.0) / 253.0, 0.0, 1.0);
  // Lines of equal clearance, a pixel wide, where they do not run together.
  float apart = max(fwidth(LINES * share), 1e-6);
  float line = 1.0 - smoothstep(0.5, 1.5, abs(fract(LINES * share + 0.5) - 0.5) / apart);
  color = vec4(mix(ramp(share), vec3(1.0), line * (1.0 - smoothstep(0.1, 0.25, apart))), 0.72);
}
