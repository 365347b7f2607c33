// The near-field light that rides on the camera: what a Gaussian of given albedo sends to the lens, and the
// gradient of that. The formula stands in light.py.

// Nothing is nearer to the lamp than this (squared, in reference distances).
constexpr float kLightSquareMin = 1e-6f;
// Beyond this angle to the lamp's axis the spread stays what it is.
constexpr float kSpreadMin = 0.1f;
// Keeps a wall seen edge-on from turning black, and the gradient of its normal bounded.
constexpr float kCosineSoftening = 0.04f;
// Gains are held within 2^-40 and 2^40.
constexpr float kLogGainMax = 40.f;
// No lobe is sharper.
constexpr float kRoughnessMin = 0.02f;

struct Lit {
  Vec offset[3];             // from the lamp to the Gaussian, in reference distances, camera frame
  Vec square, inverse_square;  // of its length
  Mask free_square, free_spread, free_gain;  // where values were not held
  Vec inverse_shifted;       // 1 / (square + softening)
  Vec inverse_cosine;        // 1 / cosine to the lamp's axis
  Mask shortest[3];          // which axis is the normal
  Vec normal[3], along;      // normal in the camera frame, its product with `offset`
  Vec squared_cosine;        // of the angle between the normal and the ray
  Vec log_fall, log_spread, log_cosine;  // in powers of two
  Vec gain;
  // Of the specular lobe, where there is one
  Mask free_lobe_gain;
  Vec missed;           // 1 - squared cosine
  Vec inverse_width;    // 1 / (squared roughness + missed (1 - squared roughness))
  Vec lobe, lobe_gain;  // its shape, 1 at its peak; what a mirror of full strength adds to the albedo
};

// Its square, held between the bound and one, where the lobe is the same in all directions
EXTRAGS_INLINE float squared_roughness(const CameraLight& light) {
  const float held = light.roughness > kRoughnessMin ? light.roughness : kRoughnessMin;
  return held < 1.f ? held * held : 1.f;
}

static __attribute__((noinline)) void illuminate(const View* view, const Projected& p, Lit& l) {
  const CameraLight& light = view->light;
  const float* r = view->camera.rotation;
  const Vec one(1.f), inverse_reference(1.f / light.reference_distance);
  const Vec* point[3] = {&p.x, &p.y, &p.z};
  for (int j = 0; j < 3; ++j) l.offset[j] = fma(*point[j], inverse_reference, Vec(-light.offset[j]));
  const Vec raw = fma(l.offset[0], l.offset[0], fma(l.offset[1], l.offset[1], l.offset[2] * l.offset[2]));
  l.free_square = ge(raw, Vec(kLightSquareMin)) & ge(Vec(1e30f), raw);
  l.square = select(ge(Vec(1e30f), raw), max(raw, Vec(kLightSquareMin)), Vec(1e30f));
  l.inverse_square = one / l.square;
  const Vec shifted = l.square + Vec(light.softening);
  l.inverse_shifted = one / shifted;
  l.log_fall = log2(Vec(1.f + light.softening)) - log2(shifted);
  const Vec cosine = l.offset[2] * sqrt(l.inverse_square);
  l.free_spread = gt(cosine, Vec(kSpreadMin));
  const Vec held = select(l.free_spread, cosine, Vec(kSpreadMin));
  l.inverse_cosine = one / held;
  l.log_spread = log2(held);
  const Mask first = ge(p.scale[1], p.scale[0]) & ge(p.scale[2], p.scale[0]);
  const Mask second = without(ge(p.scale[2], p.scale[1]), first);
  l.shortest[0] = first;
  l.shortest[1] = second;
  l.shortest[2] = without(first_lanes(16), first);
  l.shortest[2] = without(l.shortest[2], second);
  Vec normal[3];
  for (int i = 0; i < 3; ++i) {
    normal[i] = select(first, p.rotation[3 * i], select(second, p.rotation[3 * i + 1], p.rotation[3 * i + 2]));
  }
  l.along = Vec(0.f);
  for (int i = 0; i < 3; ++i) {
    l.normal[i] = fma(Vec(r[3 * i]), normal[0], fma(Vec(r[3 * i + 1]), normal[1], Vec(r[3 * i + 2]) * normal[2]));
    l.along = fma(l.normal[i], l.offset[i], l.along);
  }
  l.squared_cosine = l.along * l.along * l.inverse_square;
  l.log_cosine = Vec(0.5f) * (log2(l.squared_cosine + Vec(kCosineSoftening)) - log2(Vec(1.f + kCosineSoftening)));
  const Vec log_gain = fma(Vec(light.exponent), l.log_fall,
                           fma(Vec(light.spread), l.log_spread, Vec(light.cosine) * l.log_cosine));
  l.free_gain = ge(Vec(kLogGainMax), abs(log_gain));
  l.gain = exp2(min(max(log_gain, Vec(-kLogGainMax)), Vec(kLogGainMax)));
  if (light.specular == 0.f) return;
  const float squared = squared_roughness(light);
  l.missed = max(one - l.squared_cosine, Vec(0.f));
  l.inverse_width = one / fma(l.missed, Vec(1.f - squared), Vec(squared));
  const Vec root = Vec(squared) * l.inverse_width;
  l.lobe = root * root;
  const Vec log_lobe_gain = fma(Vec(light.exponent), l.log_fall, Vec(light.spread) * l.log_spread);
  l.free_lobe_gain = ge(Vec(kLogGainMax), abs(log_lobe_gain));
  l.lobe_gain = l.lobe * exp2(min(max(log_lobe_gain, Vec(-kLogGainMax)), Vec(kLogGainMax)));
}

// Albedo to what reaches the pixel, in place.
EXTRAGS_INLINE void develop(const View* view, const Lit& l, Vec* color) {
  const CameraLight& light = view->light;
  const bool shiny = light.specular != 0.f;
  for (int channel = 0; channel < 3; ++channel) {
    Vec signal = color[channel] * (l.gain * Vec(light.exposure[channel]));
    if (shiny) signal = fma(l.lobe_gain, Vec(light.specular * light.exposure[channel]), signal);
    color[channel] = signal * Vec(1.f + light.shoulder) / fma(Vec(light.shoulder), signal, Vec(1.f));
    const float squared_glare = light.glare[channel] * light.glare[channel];
    if (squared_glare > 0.f) color[channel] = sqrt(fma(color[channel], color[channel], Vec(squared_glare)));
  }
}

// From the gradient of the developed colours to that of the albedo (in place), of the position in the camera
// frame and of the normal there (both added to), and of the light (added to, in the order of CameraLight).
static __attribute__((noinline)) void illuminate_backward(const View* view, const Lit& l, const Vec* albedo, Vec* v_color,
                                        Vec* v_point, Vec* v_normal, Vec* v_light) {
  const CameraLight& light = view->light;
  const Vec one(1.f), ln2(kLn2);
  const bool shiny = light.specular != 0.f;
  Vec v_log(0.f), v_lobe_gain(0.f);
  for (int channel = 0; channel < 3; ++channel) {
    const Vec diffuse = albedo[channel] * l.gain;
    const Vec lit = shiny ? fma(l.lobe_gain, Vec(light.specular), diffuse) : diffuse;
    const Vec signal = lit * Vec(light.exposure[channel]);
    const Vec inverse = one / fma(Vec(light.shoulder), signal, one), squared = inverse * inverse;
    Vec v_clear = v_color[channel];
    const float squared_glare = light.glare[channel] * light.glare[channel];
    if (squared_glare > 0.f) {
      const Vec clear = signal * Vec(1.f + light.shoulder) * inverse;
      const Vec over = v_clear / sqrt(fma(clear, clear, Vec(squared_glare)));
      v_light[13 + channel] = fma(over, Vec(light.glare[channel]), v_light[13 + channel]);
      v_clear = over * clear;
    }
    const Vec v_signal = v_clear * Vec(1.f + light.shoulder) * squared;
    v_light[10] = fma(v_clear * squared, signal * (one - signal), v_light[10]);
    v_light[channel] = fma(v_signal, lit, v_light[channel]);
    v_log = fma(v_signal, diffuse * Vec(light.exposure[channel]), v_log);
    if (shiny) v_lobe_gain = fma(v_signal, Vec(light.exposure[channel]), v_lobe_gain);
    v_color[channel] = v_signal * (l.gain * Vec(light.exposure[channel]));
  }
  v_log = keep(l.free_gain, v_log);
  v_light[6] = fma(v_log * ln2, l.log_cosine, v_light[6]);
  Vec v_cosine = v_log * Vec(0.5f * light.cosine) / (l.squared_cosine + Vec(kCosineSoftening));
  if (shiny) {
    const float squared = squared_roughness(light);
    const Vec v_specular = v_lobe_gain * l.lobe_gain, v_log_lobe = v_specular * Vec(light.specular);
    v_light[11] = v_light[11] + v_specular;
    if (light.roughness > kRoughnessMin && light.roughness < 1.f) {
      // Of the logarithm of the lobe: 2 missed / (squared (squared + missed (1 - squared)))
      const Vec slope = l.missed * l.inverse_width * Vec(4.f * light.roughness / squared);
      v_light[12] = fma(v_log_lobe, slope, v_light[12]);
    }
    v_cosine = fma(v_log_lobe * Vec(2.f * (1.f - squared)), l.inverse_width, v_cosine);
    v_log = v_log + keep(l.free_lobe_gain, v_log_lobe);
  }
  // From here on what the lobe and the rest have in common
  v_light[3] = fma(v_log * Vec(light.exponent), Vec(1.f / (1.f + light.softening)) - l.inverse_shifted, v_light[3]);
  v_light[4] = fma(v_log * ln2, l.log_fall, v_light[4]);
  v_light[5] = fma(v_log * ln2, l.log_spread, v_light[5]);
  const Vec v_spread = keep(l.free_spread, v_log * Vec(light.spread));
  const Vec v_along = Vec(2.f) * v_cosine * l.along * l.inverse_square;
  Vec v_square = negated(v_log * Vec(light.exponent) * l.inverse_shifted);
  v_square = fnma(Vec(0.5f) * v_spread, l.inverse_square, v_square);
  v_square = fnma(v_cosine * l.squared_cosine, l.inverse_square, v_square);
  const Vec twice = keep(l.free_square, Vec(2.f) * v_square), inverse_reference(1.f / light.reference_distance);
  for (int j = 0; j < 3; ++j) {
    Vec v_offset = fma(twice, l.offset[j], v_along * l.normal[j]);
    if (j == 2) v_offset = fma(v_spread * l.inverse_cosine, sqrt(l.inverse_square), v_offset);
    v_light[7 + j] = v_light[7 + j] - v_offset;
    v_point[j] = fma(v_offset, inverse_reference, v_point[j]);
    v_normal[j] = fma(v_along, l.offset[j], v_normal[j]);
  }
}
