#version 300 es
// One Gaussian as a quadrilateral: projection, light and cut of extrags.raster.
precision highp float;
precision highp int;
precision highp sampler2D;
layout(location = 0) in uint index;
uniform sampler2D geometry;   // three texels each: mean and opacity, rotation (w, x, y, z), scales
uniform sampler2D harmonics;  // (degree + 1)^2 texels each
uniform sampler2D quantities; // one texel each
uniform int terms;
uniform mat4 view;            // camera from world, x right, y down, z forward
uniform mat4 lamp;            // lamp from world: the view, unless the lamp was left behind
uniform vec3 eye;             // centre of the camera in the world
uniform vec4 K;               // fx, fy, cx, cy in pixels of the canvas
uniform vec2 size;            // of the canvas in pixels
uniform float dilation;       // px^2
uniform float near;
uniform bool lit;
uniform float exposure;
uniform vec4 falloff;         // softening, exponent, spread, cosine
uniform vec4 place;           // offset of the lamp, reference distance
uniform vec3 home;            // offset that the scene was made with, from the camera that looks
uniform float shoulder;
uniform vec2 gloss;           // strength and roughness of the specular lobe
uniform vec3 glare;           // that lens and tube scatter over the image, as black shows it
uniform int shade;            // 0 colour, 1 and more: a quantity
out vec2 offset;
flat out vec3 conic;
flat out vec4 color;

const float ALPHA_MIN = 1.0 / 255.0;

vec4 texel(sampler2D table, int at) {
  int width = textureSize(table, 0).x;
  return texelFetch(table, ivec2(at % width, at / width), 0);
}

mat3 rotation(vec4 q) {
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 albedo(int id, vec3 d) {
  int first = id * terms;
  vec3 sum = 0.28209479177387814 * texel(harmonics, first).rgb;
  if (terms > 1) {
    sum += 0.4886025119029199 * (-d.y * texel(harmonics, first + 1).rgb
      + d.z * texel(harmonics, first + 2).rgb - d.x * texel(harmonics, first + 3).rgb);
  }
  if (terms > 4) {
    vec3 s = d * d;
    sum += 1.0925484305920792 * (d.x * d.y * texel(harmonics, first + 4).rgb
        - d.y * d.z * texel(harmonics, first + 5).rgb - d.x * d.z * texel(harmonics, first + 7).rgb)
      + 0.31539156525252005 * (2.0 * s.z - s.x - s.y) * texel(harmonics, first + 6).rgb
      + 0.5462742152960396 * (s.x - s.y) * texel(harmonics, first + 8).rgb;
    if (terms > 9) {
      sum += -0.5900435899266435 * d.y * (3.0 * s.x - s.y) * texel(harmonics, first + 9).rgb
        + 2.890611442640554 * d.x * d.y * d.z * texel(harmonics, first + 10).rgb
        - 0.4570457994644658 * d.y * (4.0 * s.z - s.x - s.y) * texel(harmonics, first + 11).rgb
        + 0.3731763325901154 * d.z * (2.0 * s.z - 3.0 * (s.x + s.y)) * texel(harmonics, first + 12).rgb
        - 0.4570457994644658 * d.x * (4.0 * s.z - s.x - s.y) * texel(harmonics, first + 13).rgb
        + 1.445305721320277 * d.z * (s.x - s.y) * texel(harmonics, first + 14).rgb
        - 0.5900435899266435 * d.x * (s.x - 3.0 * s.y) * texel(harmonics, first + 15).rgb;
    }
  }
  return max(sum + 0.5, 0.0);
}

// As extrags.raster.light.lit_colors while the lamp is where the scene has it. That takes the direction to the lamp
// for the one half-way to the camera; a lamp that was moved or left behind is half-way from there.
vec3 under_light(vec3 a, vec3 mean, vec3 normal) {
  vec3 d = (lamp * vec4(mean, 1.0)).xyz / place.w - place.xyz;
  float square = max(dot(d, d), 1e-6);
  float fall = log2(1.0 + falloff.x) - log2(square + falloff.x);
  float axis = log2(max(d.z * inversesqrt(square), 0.1));
  float cosine = dot(mat3(lamp) * normal, d);
  float facing = log2((cosine * cosine / square + 0.04) / 1.04);
  float arriving = falloff.y * fall + falloff.z * axis;
  float gain = exp2(clamp(arriving + 0.5 * falloff.w * facing, -40.0, 40.0));
  float rough = pow(clamp(gloss.y, 0.02, 1.0), 2.0);
  vec3 e = (view * vec4(mean, 1.0)).xyz / place.w - home;
  vec3 between = d * inversesqrt(square) * mat3(lamp) + e * inversesqrt(max(dot(e, e), 1e-6)) * mat3(view);
  float along = dot(normal, between);
  float missed = max(1.0 - along * along / max(dot(between, between), 1e-6), 0.0);
  float lobe = rough / (rough + (1.0 - rough) * missed);
  float shine = gloss.x * lobe * lobe * exp2(clamp(arriving, -40.0, 40.0));
  vec3 signal = exposure * (a * gain + shine);
  vec3 clear = (1.0 + shoulder) * signal / (1.0 + shoulder * signal);
  return sqrt(clear * clear + glare * glare);
}

vec3 ramp(float t) {
  // A dark blue, a green-blue, a pale yellow: ordered in lightness, told apart by colour-blind eyes.
  return t < 0.5 ? mix(vec3(0.17, 0.09, 0.38), vec3(0.10, 0.56, 0.55), 2.0 * t)
    : mix(vec3(0.10, 0.56, 0.55), vec3(0.99, 0.91, 0.45), 2.0 * t - 1.0);
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  int id = int(index);
  vec4 first = texel(geometry, 3 * id);
  vec3 mean = first.xyz;
  vec3 t = (view * vec4(mean, 1.0)).xyz;
  if (t.z < near || first.w < ALPHA_MIN) return;
  vec3 scale = texel(geometry, 3 * id + 2).xyz;
  mat3 turn = rotation(texel(geometry, 3 * id + 1));
  vec2 low = -(K.zw / K.xy + 0.15 * size / K.xy);
  vec2 high = (size - K.zw) / K.xy + 0.15 * size / K.xy;
  vec2 slope = clamp(t.xy / t.z, low, high);
  mat3 axes = mat3(view) * mat3(turn[0] * scale.x, turn[1] * scale.y, turn[2] * scale.z);
  vec3 u = K.x / t.z * vec3(axes[0].x - slope.x * axes[0].z, axes[1].x - slope.x * axes[1].z,
    axes[2].x - slope.x * axes[2].z);
  vec3 v = K.y / t.z * vec3(axes[0].y - slope.y * axes[0].z, axes[1].y - slope.y * axes[1].z,
    axes[2].y - slope.y * axes[2].z);
  float xx = dot(u, u) + dilation, xy = dot(u, v), yy = dot(v, v) + dilation;
  float determinant = xx * yy - xy * xy;
  if (!(determinant > 0.0)) return;
  vec2 centre = K.xy * t.xy / t.z + K.zw;
  float reach = 2.0 * log(first.w / ALPHA_MIN);
  vec2 extent = sqrt(reach * vec2(xx, yy));
  if (any(lessThan(centre + extent, vec2(0.0))) || any(greaterThan(centre - extent, size))) return;

  // The ellipse where alpha reaches 1/255, half a pixel wider for rounding.
  float middle = 0.5 * (xx + yy), apart = length(vec2(0.5 * (xx - yy), xy));
  vec2 along = abs(xy) > 1e-9 ? normalize(vec2(xy, middle + apart - xx)) : (xx >= yy ? vec2(1, 0) : vec2(0, 1));
  float longer = sqrt(reach * (middle + apart)) + 0.5, shorter = sqrt(reach * max(middle - apart, 0.0)) + 0.5;
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  offset = corner.x * longer * along + corner.y * shorter * vec2(-along.y, along.x);
  vec2 pixel = centre + offset;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
  conic = vec3(yy, -xy, xx) / determinant;

  vec3 shown = albedo(id, normalize(mean - eye));
  if (lit) {
    int shortest = scale.x <= scale.y && scale.x <= scale.z ? 0 : (scale.y <= scale.z ? 1 : 2);
    shown = under_light(shown, mean, turn[shortest]);
  }
  if (shade > 0) {
    float level = texel(quantities, id)[shade - 1] * 255.0;
    float light = clamp(dot(shown, vec3(0.3, 0.5, 0.2)), 0.0, 1.0);
    shown = (level > 254.5 ? vec3(0.6) : ramp(level / 254.0)) * (0.45 + 0.55 * light);
  }
  color = vec4(shown, first.w);
}
