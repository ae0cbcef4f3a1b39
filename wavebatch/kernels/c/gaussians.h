/* A Gaussian, further ones added to it, and derivatives: a ROW of samples at a time.

   pulse.h includes this file for rows of four samples and again for rows of eight and of sixteen: sums of learned pulses
   are half of the time of their fits. A sample goes through the same operations in the same order in all of them, so the
   bits are the same. */

/* e^a for a <= 0, error 1e-7 of the value; 0 below e^-40: nothing that small changes a fit, and squares of still smaller
   numbers make processors slow. e^a = 2^n e^r with |r| <= ln(2) / 2; the series in r is a Chebyshev fit. */
INLINE TARGET ROW OF(exp)(ROW a) {
    const ROW least = (ROW){0} - 40.f;
    const BITS is_in = a > least;
    ROW inside = (ROW)((is_in & (BITS)a) | (~is_in & (BITS)least));
    BITS n = __builtin_convertvector(inside * 1.44269504f - 0.5f, BITS);
    ROW whole = __builtin_convertvector(n, ROW);
    ROW r = inside - whole * 0.693145752f - whole * 1.42860677e-6f;
    ROW series = ((r * 1.39336509e-3f + 8.36317986e-3f) * r + 4.16664667e-2f) * r + 1.66665763e-1f;
    BITS scale = (n + 127) << 23;
    return (ROW)(is_in & (BITS)(((series * r + 0.5f) * r * r + r + 1.f) * (ROW)scale));
}

/* Adds terms to vectors v .. of a pulse, or sets it to their sum where `main` is one more, as far as whole rows go.
   Returns the first vector that is not done. */
static TARGET int64_t OF(add_gaussians)(const Term *main, const Term *terms, int64_t n, const lanes *x, int64_t v, int64_t vectors, Basis out) {
    const int64_t step = sizeof(ROW) / sizeof(lanes);
    for (; v < vectors; v += step) {
        if (v + step > vectors) {
            if (!main || vectors < step) break;
            v = vectors - step; /* some are set once more, to the same */
        }
        const ROW at = *(const ROW *)(x + v);
        ROW *to = (ROW *)(out.pulse + v), *to_time = (ROW *)(out.by_time + v), *to_width = (ROW *)(out.by_width + v);
        ROW pulse, by_time, by_width;
        if (main) {
            ROW z = (at - main->whole - main->part) * main->inverse;
            pulse = OF(exp)(z * z * -0.5f);
            by_time = pulse * z;
            by_width = by_time * z;
        } else {
            pulse = *to; by_time = *to_time; by_width = *to_width;
        }
        for (const Term *t = terms; t < terms + n; t++) {
            ROW z = (at - t->whole - t->part) * t->inverse, bell = OF(exp)(z * z * -0.5f) * t->weight, slope = bell * z * t->ratio;
            pulse += bell;
            by_time += slope;
            by_width += bell * t->rest + slope * z * t->ratio;
        }
        *to = pulse; *to_time = by_time; *to_width = by_width;
    }
    return v;
}
