/* Four samples at a time. `lanes` is a vector type of GCC and Clang: a + b * c works on all four, as in NumPy.

   Sums run in four fixed parts that are then added in a fixed order, so that builds for SSE2, AVX2, AVX-512 and NEON
   give the same bits. Four fill one register of every processor; eight and sixteen were 1.4 and 1.7 times slower on
   plain x86-64. Nothing here calls the mathematics library but for functions that are exact (sqrt, rint, ceil): its
   other results depend on the processor. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define LANES 4
#define INLINE static inline __attribute__((always_inline))
typedef float lanes __attribute__((vector_size(4 * LANES), aligned(16)));
typedef double wide __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int64_t wide_bits __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int32_t lane_bits __attribute__((vector_size(4 * LANES), aligned(16)));

#define ALL(number) ((lanes){0} + (float)(number))
#define VECTORS(samples) (((samples) + LANES - 1) / LANES)

INLINE lanes pick(lane_bits on, lanes yes, lanes no) { return (lanes)((on & (lane_bits)yes) | (~on & (lane_bits)no)); }
INLINE lanes least_of(lanes a, lanes b) { return pick(a < b, a, b); }
INLINE lanes most_of(lanes a, lanes b) { return pick(a > b, a, b); }

/* As fmax and fmin of a value, which may be no number, and a bound: those are calls. */
INLINE double at_least(double value, double bound) { return value > bound ? value : bound; }
INLINE double at_most(double value, double bound) { return value < bound ? value : bound; }

INLINE float sum_lanes(lanes v) { return (v[0] + v[2]) + (v[1] + v[3]); }

/* `sum_lanes` of four at once. */
INLINE lanes sum_four(lanes a, lanes b, lanes c, lanes d) {
    const lanes one = (lanes){a[0], b[0], a[1], b[1]} + (lanes){a[2], b[2], a[3], b[3]};
    const lanes two = (lanes){c[0], d[0], c[1], d[1]} + (lanes){c[2], d[2], c[3], d[3]};
    return (lanes){one[0], one[1], two[0], two[1]} + (lanes){one[2], one[3], two[2], two[3]};
}

/* The inner product of n vectors; once in float32, once in float64. */
INLINE double multiply(int64_t n, const lanes *a, const lanes *b) {
    lanes sum = ALL(0);
    for (int64_t v = 0; v < n; v++) sum += a[v] * b[v];
    return sum_lanes(sum);
}

INLINE double multiply_wide(int64_t n, const lanes *a, const lanes *b) {
    wide sum = {0};
    for (int64_t v = 0; v < n; v++) sum += __builtin_convertvector(a[v], wide) * __builtin_convertvector(b[v], wide);
    return (sum[0] + sum[2]) + (sum[1] + sum[3]);
}

/* ln a for a > 0, error 1e-7: a = 2^n m with m near 1, ln m = 2 atanh((m - 1) / (m + 1)) as its series. */
INLINE lanes log_lanes(lanes a) {
    lane_bits bits = (lane_bits)a - 0x3f3504f3, n = bits >> 23; /* from the root of 1/2 on */
    lanes m = (lanes)((bits & 0x7fffff) + 0x3f3504f3), q = (m - 1.f) / (m + 1.f), s = q * q;
    lanes series = (((s * 0.1111111f + 0.14285714f) * s + 0.2f) * s + 0.33333333f) * s + 1.f;
    return __builtin_convertvector(n, lanes) * 0.69314718f + 2.f * q * series;
}

/* ln(1 + a) for a > -1, exact for small a too: rounding of 1 + a is made good by the factor a / ((1 + a) - 1). */
INLINE lanes log1p_lanes(lanes a) {
    lanes one = a + 1.f, rounded = one - 1.f;
    return pick(rounded == 0.f, a, log_lanes(one) * a / pick(rounded == 0.f, ALL(1), rounded));
}

#define ROW wide
#define BITS wide_bits
#define OF(name) name##_wide
#define TARGET
#include "exponential.h"
#undef ROW
#undef BITS
#undef OF
#undef TARGET

static double exp_double(double a) { return exp_wide((wide){a})[0]; }

/* ln a in double precision, error 2e-16 of the value. */
static double log_double(double a) {
    if (!(a > 0) || a == INFINITY) return a == 0 ? -INFINITY : a > 0 ? a : NAN;
    int extra = a < 2.2250738585072014e-308 ? 54 : 0; /* of numbers below the normal ones */
    if (extra) a *= 18014398509481984.0;
    uint64_t bits;
    memcpy(&bits, &a, sizeof bits);
    int64_t n = (int64_t)((bits - 0x3fe6a09e667f3bcdu) >> 52); /* from the root of 1/2 on */
    n = n >= 2048 ? n - 4096 : n;
    bits -= (uint64_t)n << 52;
    double m, sum = 0;
    memcpy(&m, &bits, sizeof m);
    double q = (m - 1) / (m + 1), s = q * q;
    for (int i = 23; i > 1; i -= 2) sum = (sum + 1.0 / i) * s; /* the series of 2 atanh(q) */
    n -= extra;
    return n * 6.93147180369123816490e-01 + (n * 1.90821492927058770002e-10 + 2 * q * sum + 2 * q);
}

/* The same of four normal numbers above 0; n becomes a double as exp_wide makes whole numbers. */
INLINE wide log_wide(wide a) {
    const wide_bits bits = (wide_bits)a, whole = (bits - 0x3fe6a09e667f3bcd) >> 52;
    const wide m = (wide)(bits - (whole << 52)), n = (wide)((wide_bits)((wide){0} + 6755399441055744.0) + whole) - 6755399441055744.0;
    const wide q = (m - 1) / (m + 1), s = q * q;
    wide sum = {0};
    for (int i = 23; i > 1; i -= 2) sum = (sum + 1.0 / i) * s;
    return n * 6.93147180369123816490e-01 + (n * 1.90821492927058770002e-10 + 2 * q * sum + 2 * q);
}
