/* One echo on the samples of a window: its pulse and the derivatives, docs/algorithms.md 0 and R1.

   With amplitude A and width w the Jacobian is pulse, A/w by_time, A/w by_width, A by_skew. */

typedef struct { lanes *pulse, *by_time, *by_width, *by_skew; } Basis;
typedef struct { double amplitude, time, width, skew; } Echo;

/* Distance from the echo in widths. The time is split, because x - time would lose digits far from the window's begin. */
INLINE lanes distance(lanes x, float whole, float part, float inverse) { return (x - whole - part) * inverse; }

typedef struct { float whole, part, inverse, weight, ratio, rest; } Term; /* a Gaussian; ratio of the main width to its own */

#define ROW lanes
#define BITS lane_bits
#define OF(name) name##_lanes
#define TARGET
#include "gaussians.h"
#undef ROW
#undef BITS
#undef OF
#undef TARGET

#ifndef WIDEST
#define WIDEST 16                              /* samples taken at a time where the processor can; tests ask for 4 and 8 */
#endif
#if defined(__x86_64__) && !defined(_WIN32) && WIDEST > 4 /* Windows does not align eight samples on its stack */
#include <cpuid.h>

typedef float octet __attribute__((vector_size(32), aligned(16), may_alias));
typedef int32_t octet_bits __attribute__((vector_size(32), aligned(16), may_alias));
#define ROW octet
#define BITS octet_bits
#define OF(name) name##_octet
#define AVX2 __attribute__((target("avx2")))
#define TARGET AVX2
#include "gaussians.h"
#undef ROW
#undef BITS
#undef OF
#undef TARGET

typedef float sixteen __attribute__((vector_size(64), aligned(16), may_alias));
typedef int32_t sixteen_bits __attribute__((vector_size(64), aligned(16), may_alias));
#define ROW sixteen
#define BITS sixteen_bits
#define OF(name) name##_sixteen
#define TARGET __attribute__((target("avx512f,avx512dq")))
#include "gaussians.h"
#undef ROW
#undef BITS
#undef OF

typedef double eight __attribute__((vector_size(64), aligned(8)));
typedef int64_t eight_bits __attribute__((vector_size(64), aligned(8)));
#define ROW eight
#define BITS eight_bits
#define OF(name) name##_eight
#include "exponential.h"

static int has_eight, has_sixteen;             /* whether processor and system have AVX2, and AVX-512 */

__attribute__((constructor)) static void look_for_vectors(void) {
    unsigned a, b, c, d, kept;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE)) return;
    __asm__("xgetbv" : "=a"(kept), "=d"(d) : "c"(0));
    has_eight = (kept & 6) == 6 && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & bit_AVX2);
    has_sixteen = WIDEST > 8 && has_eight && (kept & 0xe0) == 0xe0 && (b & bit_AVX512F) && (b & bit_AVX512DQ);
}
#else
enum { has_eight = 0, has_sixteen = 0 };
#define add_gaussians_octet add_gaussians_lanes
#define add_gaussians_sixteen add_gaussians_lanes
#define exponentials_eight exponentials_wide
#define AVX2
#endif

/* Offers a function, NAME_any, compiled for AVX2 too with all that it calls, where one register holds twice as much: the same
   operations, the same bits. */
#define OFFER(NAME, PARAMETERS, ARGUMENTS) \
    AVX2 __attribute__((flatten)) static int64_t NAME##_avx2 PARAMETERS { return NAME##_any ARGUMENTS; } \
    EXPORT int64_t NAME PARAMETERS { return has_eight ? NAME##_avx2 ARGUMENTS : NAME##_any ARGUMENTS; }

static void sum_of_gaussians(const Pulse *shape, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    enum { TOGETHER = 8 };
    const Term main = {rint(echo->time), echo->time - rint(echo->time), 1 / echo->width, 1, 1, 0};
    Term terms[TOGETHER];
    int64_t c = 0, n, done;
    do {
        for (n = 0; n < TOGETHER && c + n < shape->n_components; n++) {
            const double *component = shape->components + 3 * (c + n);
            const double place = echo->time + component[1], wide = sqrt(echo->width * echo->width + component[2]);
            const float weight = component[0], ratio = echo->width / wide;
            terms[n] = (Term){rint(place), place - rint(place), 1 / wide, weight * ratio, ratio, 1 - ratio * ratio};
        }
        const Term *first = c ? NULL : &main;
        done = has_sixteen ? add_gaussians_sixteen(first, terms, n, x, 0, vectors, out) : 0;
        done = has_eight ? add_gaussians_octet(first, terms, n, x, done, vectors, out) : done;
        add_gaussians_lanes(first, terms, n, x, done, vectors, out);
        c += n;
    } while (c < shape->n_components);
}

/* exp(-L^2 / 2) with L = ln(1 + kappa z) / kappa, and the derivative by kappa. Near kappa = 0 L is its series. */
static void skewed(double kappa, int is_free, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    float whole = rint(echo->time), part = echo->time - rint(echo->time), inverse = 1 / echo->width, skew = kappa;
    int is_small = fabs(kappa) < 1e-3;
    for (int64_t v = 0; v < vectors; v++) {
        lanes z = distance(x[v], whole, part, inverse), grown = z * skew;
        lane_bits inside = grown > -0.999999f;
        grown = pick(inside, grown, ALL(0));
        lanes level = is_small ? z - z * z * (skew * 0.5f) + z * z * z * (skew * skew / 3) : log1p_lanes(grown) * (1 / skew);
        lanes pulse = pick(inside, exp_lanes(level * level * -0.5f), ALL(0)), slope = pulse * level / (grown + 1.f);
        out.pulse[v] = pulse;
        out.by_time[v] = slope;
        out.by_width[v] = slope * z;
        if (is_free) {
            lanes bend = is_small ? z * z * z * (skew * 2 / 3) - z * z * 0.5f : (z / (grown + 1.f) - level) * (1 / skew);
            out.by_skew[v] = pulse * level * bend * -1.f;
        }
    }
}

static void power_law(double power, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    float whole = rint(echo->time), part = echo->time - rint(echo->time), inverse = 1 / echo->width;
    for (int64_t v = 0; v < vectors; v++) {
        lanes z = distance(x[v], whole, part, inverse), away = most_of(most_of(z, -z), ALL(1e-6));
        lanes level = log_lanes(away) * (float)power, small = exp_lanes(most_of(least_of(level, -level), ALL(-39)));
        lanes grown = pick(level > 0.f, 1.f / small, small); /* |z|^power */
        lanes pulse = exp_lanes(grown * -0.5f);
        out.pulse[v] = pulse;
        out.by_width[v] = grown * pulse * (float)(0.5 * power);
        out.by_time[v] = out.by_width[v] / pick(z < 0.f, -away, away);
    }
}

static void table(const Pulse *shape, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    float whole = rint(echo->time), part = echo->time - rint(echo->time), inverse = 1 / echo->width;
    for (int64_t v = 0; v < vectors; v++) {
        lanes z = distance(x[v], whole, part, inverse);
        lanes place = (z - (float)shape->first) * (float)(1 / shape->step);
        place = least_of(most_of(place, ALL(0)), ALL(shape->n_rows - 1.001));
        lanes value, slope;
        for (int i = 0; i < LANES; i++) {
            int row = (int)place[i];
            float share = place[i] - row;
            value[i] = shape->value[row] + share * (shape->value[row + 1] - shape->value[row]);
            slope[i] = shape->slope[row] + share * (shape->slope[row + 1] - shape->slope[row]);
        }
        out.pulse[v] = value;
        out.by_time[v] = -slope;
        out.by_width[v] = -slope * z;
    }
}

INLINE void evaluate_pulse(const Pulse *shape, int is_free, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    if (is_free) skewed(echo->skew, 1, echo, x, vectors, out);
    else if (shape->kind == SKEWED) skewed(shape->skew, 0, echo, x, vectors, out);
    else if (shape->kind == POWER) power_law(shape->power, echo, x, vectors, out);
    else if (shape->kind == TABLE) table(shape, echo, x, vectors, out);
    else sum_of_gaussians(shape, echo, x, vectors, out);
}
