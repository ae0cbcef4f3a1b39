/* One echo on the samples of a window: its pulse and the derivatives, docs/algorithms.md 0 and R1.

   With amplitude A and width w the Jacobian is pulse, A/w by_time, A/w by_width, A by_skew. */

typedef struct { lanes *pulse, *by_time, *by_width, *by_skew; } Basis;
typedef struct { double amplitude, time, width, skew; } Echo;

/* Distance from the echo in widths. The time is split, because x - time would lose digits far from the window's begin. */
INLINE lanes distance(lanes x, float whole, float part, float inverse) { return (x - whole - part) * inverse; }

INLINE void add_component(lanes x, float whole, float part, float inverse, float weight, float ratio, Basis out, int64_t v) {
    lanes z = distance(x, whole, part, inverse), bell = exp_lanes(z * z * -0.5f) * (weight * ratio), slope = bell * z * ratio;
    out.pulse[v] += bell;
    out.by_time[v] += slope;
    out.by_width[v] += bell * (1 - ratio * ratio) + slope * z * ratio;
}

static void sum_of_gaussians(const Pulse *shape, const Echo *echo, const lanes *x, int64_t vectors, Basis out) {
    float whole = rint(echo->time), part = echo->time - rint(echo->time), inverse = 1 / echo->width;
    for (int64_t v = 0; v < vectors; v++) {
        lanes z = distance(x[v], whole, part, inverse);
        out.pulse[v] = exp_lanes(z * z * -0.5f);
        out.by_time[v] = out.pulse[v] * z;
        out.by_width[v] = out.by_time[v] * z;
    }
    for (int64_t c = 0; c < shape->n_components; c++) {
        const double *component = shape->components + 3 * c;
        double place = echo->time + component[1], wide = sqrt(echo->width * echo->width + component[2]);
        for (int64_t v = 0; v < vectors; v++)
            add_component(x[v], rint(place), place - rint(place), 1 / wide, component[0], echo->width / wide, out, v);
    }
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
