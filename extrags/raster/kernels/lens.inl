// A radial lens: with w = tan^2 of the angle from the axis, its gain G = r / tan and the derivatives by w. See
// lens_projection.py, the specification.

// Arctangent of t >= 0.41, to about 1e-7: Cephes' polynomial after reduction to [-0.42, 0.42].
EXTRAGS_INLINE Vec arctangent(Vec t) {
  const Vec one(1.f);
  const Mask steep = gt(t, Vec(2.414213562f));
  const Vec x = select(steep, Vec(-1.f), t - one) / select(steep, t, t + one);
  const Vec square = x * x;
  const Vec tail = fma(fma(fma(Vec(8.05374449538e-2f), square, Vec(-1.38776856032e-1f)), square,
                           Vec(1.99777106478e-1f)), square, Vec(-3.33329491539e-1f)) * square;
  return select(steep, Vec(1.57079632679f), Vec(0.78539816340f)) + fma(tail, x, x);
}

struct Gain {
  Vec value, first, second;
};

EXTRAGS_INLINE Gain lens_gain(const RadialLens& lens, Vec w) {
  const Mask near_axis = ge(Vec(kSeriesSquare), w);
  Gain gain{Vec(0.f), Vec(0.f), Vec(0.f)};
  if (any(near_axis)) {
    const Vec held = keep(near_axis, w);
    Vec half_second(0.f);
    for (int k = kSeriesTerms - 1; k >= 0; --k) {
      half_second = fma(half_second, held, gain.first);
      gain.first = fma(gain.first, held, gain.value);
      gain.value = fma(gain.value, held, Vec(lens.series[k]));
    }
    gain.second = half_second + half_second;
  }
  const Mask outer = gt(w, Vec(kSeriesSquare));
  if (!any(outer)) return gain;
  const Vec one(1.f), two(2.f), square = select(outer, w, one);
  const Vec tangent = sqrt(square), angle = arctangent(tangent);
  const Vec end(lens.linear_from), held = min(angle, end), q = held * held;
  const float *k = lens.coefficients;
  const Vec radius = held * fma(q, fma(q, fma(q, fma(q, Vec(k[3]), Vec(k[2])), Vec(k[1])), Vec(k[0])), one);
  const Vec slope = fma(q, fma(q, fma(q, fma(q, Vec(9.f * k[3]), Vec(7.f * k[2])), Vec(5.f * k[1])),
                               Vec(3.f * k[0])), one);
  const Vec bend = keep(gt(end, angle),
                        held * fma(q, fma(q, fma(q, Vec(72.f * k[3]), Vec(42.f * k[2])), Vec(20.f * k[1])),
                                   Vec(6.f * k[0])));
  const Vec secant = one / (one + square);  // d(angle) / d(tangent)
  const Vec halved = Vec(0.5f) / square;
  const Vec value = fma(slope, angle - held, radius) / tangent;
  const Vec first = fma(slope, secant, negated(value)) * halved;
  const Vec turned = secant * secant * fma(bend, Vec(0.5f) / tangent, negated(slope));
  const Vec second = fma(Vec(-3.f), first, turned) * halved;
  gain.value = select(outer, value, gain.value);
  gain.first = select(outer, first, gain.first);
  gain.second = select(outer, second, gain.second);
  return gain;
}
