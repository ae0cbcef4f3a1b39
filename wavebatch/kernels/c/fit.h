/* Least squares of k overlapping echoes in one window by Levenberg and Marquardt's steps, docs/algorithms.md 2.3.

   Equations are in units in which each row has about the same scale, so that their condition is that of the overlap
   alone: products in float32 are then exact enough, solutions need float64 (H2). Functions take `k` and `per` as
   arguments, so that the compiler makes copies for one and two echoes, which are most. */

static const double DAMPING = 0.01;            /* of the first step, in units of the diagonal */
static const double KEPT = 0.75, EASE = 0.2;   /* a step that keeps so much of its promise eases the damping */
static const double RAISE = 4;                 /* one that is refused raises it, the next in a row twice as much */
static const double RIDGE = 1e-9;              /* an echo outside its window must not make the equations singular */
static const double LONG_STEP = 0.1;           /* longer steps, in widths or amplitudes, are never taken unchecked:
                                                  along the curved valley of overlapping echoes some end 250 in chi2 worse */
static const double STEEP = 1e3;               /* variance inflation from which products are taken in float64 (H2) */
static const double UNDETERMINED = 1e30;       /* pivot of an unknown that the data do not determine: it stays 0 */
static const int MOST_IDLE = 2;                /* iterations with an echo of no amplitude, whose time then drifts: it is
                                                  left out before the others are fitted on (decompose.h) */
static const int CENSORED = 100;               /* least iterations with clipped samples: starts are far off (H6) */

static const double LEAST_AWAY = 0.25;         /* of a peak from a log-normal's origin, where the pulse has no width */
static const double LEAST_WIDTH = 0.1;         /* below it a fit without damping is lost: the echo lies on one sample */

typedef struct { double low[4], high[4]; } Limits;

/* The sample of the window at which a log-normal as printed in papers begins, 1.2. */
INLINE double origin_of(const Settings *s, const Window *w) { return s->pulse.from_waveform ? -1.0 - w->begin : -1; }

/* A log-normal whose skew is tied to its origin: kappa = width / (time - origin). */
static void log_normal(double origin, const Echo *echo, const Window *w, lanes *by_skew, Basis row) {
    const float skew = echo->width / fmax(echo->time - origin, LEAST_AWAY);
    row.by_skew = by_skew;
    skewed(skew, 1, echo, w->x, w->vectors, row);
    for (int64_t v = 0; v < w->vectors; v++) {
        row.by_time[v] -= by_skew[v] * (skew * skew);
        row.by_width[v] += by_skew[v] * skew;
    }
}

/* The rows of the model: pulses, derivatives, residual. Clipped samples count only where the model lies below them. Levels
   are still in them: `find_products` takes them off the products, which is less work. */
INLINE void evaluate_rows(int64_t k, int64_t per, const Settings *s, Work *work, const double *p) {
    const Window *w = &work->window;
    const int64_t n = w->vectors;
    lanes *residual = work->rows + per * k * n;
    memcpy(residual, w->y, n * sizeof(lanes));
    for (int64_t j = 0; j < k; j++) {
        Echo echo = {p[j], p[k + j], p[2 * k + j], per > 3 ? p[3 * k + j] : 0};
        Basis row = {work->rows + j * n, work->rows + (k + j) * n, work->rows + (2 * k + j) * n, work->rows + (3 * k + j) * n};
        if (s->pulse.kind == LOG_NORMAL) log_normal(origin_of(s, w), &echo, w, residual + n, row);
        else evaluate_pulse(&s->pulse, per > 3, &echo, w->x, n, row);
        const float amplitude = echo.amplitude;
        for (int64_t v = 0; v < n; v++) residual[v] -= row.pulse[v] * amplitude;
    }
    for (int64_t v = 0; v < n && (w->any_clipped || w->is_weighted); v++) {
        lanes weight = w->is_weighted ? w->weight[v] : ALL(1);
        if (w->any_clipped) weight = pick((w->clipped[v] != 0.f) & (residual[v] * w->clipped[v] <= 0.f), ALL(0), weight);
        for (int64_t i = 0; i <= per * k; i++) work->rows[i * n + v] *= weight;
    }
    for (int64_t i = 0; i <= per * k && w->is_whitened; i++) whiten(w, work->rows + i * n);
}

/* Inner products of rows at .. at + 3, as many as there are. */
INLINE void multiply_corner(int64_t rows, int64_t vectors, const lanes *row, int64_t at, double *gram) {
    const lanes *some[4];
    lanes sum[12] = {{0}};
    for (int64_t i = 0; i < 4; i++) some[i] = row + (at + i < rows ? at + i : at) * vectors;
    for (int64_t v = 0; v < vectors; v++)
        for (int64_t i = 0, q = 0; i < 4; i++)
            for (int64_t j = 0; j <= i; j++, q++) sum[q] += some[i][v] * some[j][v];
    const lanes done[] = {sum_four(sum[0], sum[1], sum[2], sum[3]), sum_four(sum[4], sum[5], sum[6], sum[7]), sum_four(sum[8], sum[9], sum[9], sum[9])};
    for (int64_t i = 0, q = 0; i < 4 && at + i < rows; i++)
        for (int64_t j = 0; j <= i; j++, q++) gram[(at + i) * rows + at + j] = done[q / 4][q % 4];
}

/* Inner products of row i, and of the next where there is one, with rows at .. at + 3 before them. */
INLINE void multiply_pair(int64_t rows, int64_t vectors, const lanes *row, int64_t i, int64_t at, double *gram) {
    const int64_t next = i + 1 < rows;
    const lanes *one = row + i * vectors, *two = one + next * vectors, *other = row + at * vectors;
    lanes sum[8] = {{0}};
    for (int64_t v = 0; v < vectors; v++)
        for (int64_t q = 0; q < 4; q++) {
            sum[q] += one[v] * other[q * vectors + v];
            if (next) sum[4 + q] += two[v] * other[q * vectors + v];
        }
    lanes done = sum_four(sum[0], sum[1], sum[2], sum[3]);
    for (int64_t q = 0; q < 4; q++) gram[i * rows + at + q] = done[q];
    if (!next) return;
    done = sum_four(sum[4], sum[5], sum[6], sum[7]);
    for (int64_t q = 0; q < 4; q++) gram[(i + 1) * rows + at + q] = done[q];
}

/* Inner products of all rows: the lower triangle of gram, (rows, rows). To wait for each addition of a sum takes longer than
   to make it, so there are four to ten sums at a time. */
INLINE void multiply_rows(int64_t rows, int64_t vectors, const lanes *row, double *gram) {
    for (int64_t at = 0; at < rows; at += 4) {
        multiply_corner(rows, vectors, row, at, gram);
        for (int64_t i = at + 4; i < rows; i += 2) multiply_pair(rows, vectors, row, i, at, gram);
    }
}

/* Takes off the products of row i with those up to it what `take_level_off` would take off both: (I - l l')^2 = I - (2 - l'l) l l'.
   along: the product of row i and the level. */
INLINE void take_level_off_products(Work *work, int64_t i, double along, double *restrict products) {
    const double share = (2 - work->window.level_share) * along, *restrict before = work->along;
    work->along[i] = along;
    for (int64_t j = 0; j <= i; j++) products[j] -= share * before[j];
}

/* Inner products of the rows without their levels. */
INLINE void find_products(int64_t rows, Work *work, double *gram) {
    const Window *w = &work->window;
    const int64_t n = w->vectors;
    multiply_rows(rows, n, work->rows, gram);
    for (int64_t i = 0; i < rows && w->level_share > 0; i += 4) {
        const lanes *row[4];
        lanes sum[4] = {{0}};
        for (int64_t q = 0; q < 4; q++) row[q] = work->rows + (i + q < rows ? i + q : i) * n;
        for (int64_t v = 0; v < n; v++)
            for (int64_t q = 0; q < 4; q++) sum[q] += row[q][v] * w->level[v];
        const lanes along = sum_four(sum[0], sum[1], sum[2], sum[3]);
        for (int64_t q = 0; q < 4 && i + q < rows; q++) take_level_off_products(work, i + q, along[q], gram + (i + q) * rows);
    }
}

/* Adds to the products what is known of widths (H1) and skews (1.2) before the fit; the cost of that. */
INLINE double add_prior(int64_t k, int64_t per, const Prior *prior, double std, const double *p, double *gram) {
    const int64_t rows = per * k + 1;
    double cost = 0;
    for (int64_t j = 0; j < k; j++) {
        double height = at_least(p[j], 0.5 * std), lack = prior->width - p[2 * k + j];
        if (prior->spread > 0 && (lack > 0 || prior->both)) {
            double unit = p[2 * k + j] / height, weight = std * std / (prior->spread * prior->spread);
            int64_t at = 2 * k + j;
            cost += weight * lack * lack;
            gram[at * rows + at] += weight * unit * unit;
            gram[(rows - 1) * rows + at] += weight * unit * lack;
        }
        if (per > 3 && prior->skew_spread > 0) {
            double unit = 1 / height, weight = std * std / (prior->skew_spread * prior->skew_spread);
            int64_t at = 3 * k + j;
            lack = prior->skew - p[at];
            cost += weight * lack * lack;
            gram[at * rows + at] += weight * unit * unit;
            gram[(rows - 1) * rows + at] += weight * unit * lack;
        }
    }
    return cost;
}

/* matrix = L D L', in place, from what is below its diagonal: L there, D L' above it, 1 / D on it; D in pivot. Pivots up to
   `least` are as if infinite. Loops run along rows, and divide once for each: to wait for numbers is most of their time. */
INLINE void factor(int64_t n, double *matrix, double *pivot, double least) {
    for (int64_t j = 0; j < n; j++) {
        double *restrict column = matrix + j * n;
        pivot[j] = column[j] > least ? column[j] : UNDETERMINED;
        column[j] = 1 / pivot[j];
        for (int64_t i = j + 1; i < n; i++) {
            double *restrict row = matrix + i * n;
            column[i] = row[j];
            row[j] *= column[j];
            for (int64_t m = j + 1; m <= i; m++) row[m] -= row[j] * column[m];
        }
    }
}

/* Solves the equations that `factor` left, in place. */
INLINE void solve(int64_t n, const double *factors, double *restrict right) {
    for (int64_t j = 0; j < n; j++) {
        const double *restrict row = factors + j * n, share = right[j] * row[j];
        for (int64_t i = j + 1; i < n; i++) right[i] -= row[i] * share;
        right[j] = share;
    }
    for (int64_t i = n - 1; i > 0; i--)
        for (int64_t j = 0; j < i; j++) right[j] -= factors[i * n + j] * right[i];
}

/* LANES columns, from one on, of the inverse of what `factor` left, side by side, down to row `to`; above it is no result. */
INLINE void invert_columns(int64_t n, const double *factors, int64_t from, int64_t to, wide *column) {
    memset(column, 0, n * sizeof(wide));
    for (int64_t q = 0; q < LANES && from + q < n; q++) column[from + q][q] = 1;
    for (int64_t j = from; j < n; j++) {
        const wide share = column[j] * factors[j * n + j];
        for (int64_t i = j + 1; i < n; i++) column[i] -= factors[j * n + i] * share;
        column[j] = share;
    }
    for (int64_t i = n - 1; i > to; i--)
        for (int64_t j = to; j < i; j++) column[j] -= factors[i * n + j] * column[i];
}

/* What one unit of a row's coefficient means: 1 for amplitudes, width / amplitude for times and widths, 1 / amplitude
   for skews. Amplitudes below half of the noise count as that. */
INLINE double unit_of(int64_t k, int64_t i, const double *p, double std) {
    int64_t kind = i / k, j = i - kind * k;
    double height = at_least(p[j], 0.5 * std);
    return kind == 0 ? 1 : kind == 3 ? 1 / height : p[2 * k + j] / height;
}

/* Marquardt's step in units of the rows, 0 where a limit holds a parameter; returns the fall of the cost it promises. */
INLINE double find_step(int64_t k, int64_t per, Work *work, const double *p, const double *gram, const Limits *limits, double damping) {
    const int64_t n = per * k, rows = n + 1;
    const double *slope = gram + n * rows;
    double promise = 0;
    int any_frozen = 0;
    for (int64_t i = 0; i < n; i++) {
        int64_t kind = i / k;
        work->frozen[i] = (p[i] <= limits->low[kind] && slope[i] < 0) || (p[i] >= limits->high[kind] && slope[i] > 0);
        any_frozen |= work->frozen[i];
    }
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j <= i; j++)
            work->matrix[i * n + j] = any_frozen && (work->frozen[i] || work->frozen[j]) ? 0 : gram[i * rows + j];
        work->matrix[i * n + i] = work->matrix[i * n + i] * (1 + damping) + RIDGE;
        work->step[i] = work->frozen[i] ? 0 : slope[i];
    }
    factor(n, work->matrix, work->pivot, 1e-300);
    solve(n, work->matrix, work->step);
    for (int64_t i = 0; i < n; i++) promise += work->frozen[i] ? 0 : work->step[i] * slope[i];
    return promise;
}

/* The parameters after the step, within their limits; returns whether a step is long. */
INLINE int take_step(int64_t k, int64_t per, const Work *work, const double *p, const Limits *limits, double std, double *after) {
    int is_long = 0;
    for (int64_t i = 0; i < per * k; i++) {
        int64_t kind = i / k, j = i - kind * k;
        after[i] = at_most(at_least(p[i] + work->step[i] * unit_of(k, i, p, std), limits->low[kind]), limits->high[kind]);
        double scale = kind == 0 ? p[j] + std : kind == 3 ? 1 : p[2 * k + j];
        is_long |= fabs(after[i] - p[i]) > LONG_STEP * scale;
    }
    return is_long;
}

INLINE int has_vanished(int64_t k, const double *amplitude) {
    int any = 0;
    for (int64_t j = 0; j < k; j++) any |= amplitude[j] <= 0;
    return any;
}

/* Fits from fit->parameters. Given up as hopeless where it cannot come below the cost `target`. */
INLINE void fit_echoes(int64_t k, int64_t per, const Settings *s, const Limits *limits, double target, Work *work) {
    const int64_t n = per * k, rows = n + 1;
    const double std = work->window.std, variance = std * std;
    int64_t most = work->window.any_clipped && s->max_iterations < CENSORED ? CENSORED : s->max_iterations;
    Fit *fit = &work->fit;
    double *trial = work->kept, damping = DAMPING, promised = INFINITY, raise = RAISE;
    int idle = 0;
    for (int64_t i = 0; i < n; i++) trial[i] = at_most(at_least(fit->parameters[i], limits->low[i / k]), limits->high[i / k]);
    fit->cost = INFINITY; fit->converged = fit->hopeless = 0;
    for (int64_t iteration = 0;; iteration++) {
        evaluate_rows(k, per, s, work, trial);
        find_products(rows, work, work->products);
        double cost = work->products[n * rows + n] + add_prior(k, per, &fit->prior, std, trial, work->products), before = fit->cost;
        int accepted = iteration == 0 || cost <= fit->cost * (1 + 1e-6);
        if (iteration) damping = at_least(damping * (!accepted ? raise : fit->cost - cost > KEPT * promised ? EASE : 1), 1e-7);
        raise = accepted ? RAISE : 2 * raise;
        if (accepted) {
            memcpy(fit->parameters, trial, n * sizeof(double));
            double *kept = fit->gram;
            fit->gram = work->products; work->products = kept;
            fit->cost = cost;
        }
        idle = k > 1 && has_vanished(k, fit->parameters) ? idle + 1 : 0;
        if (idle == MOST_IDLE) return;
        promised = find_step(k, per, work, fit->parameters, fit->gram, limits, damping);
        int is_long = take_step(k, per, work, fit->parameters, limits, std, trial);
        int settled = accepted && promised < s->tolerance * variance && !is_long;
        fit->converged = settled || (iteration > 3 && accepted && before - fit->cost < 0.1 * s->tolerance * variance);
        fit->hopeless = iteration >= 2 && fit->cost - 4 * promised > target * variance;
        if (fit->hopeless) return;
        if (!fit->converged && damping <= 1e6 && iteration + 1 < most) continue;
        if (settled) { memcpy(fit->parameters, trial, n * sizeof(double)); fit->cost -= promised; } /* so short a step needs no check */
        fit->cost /= variance;
        if (fit->converged) return;
        evaluate_rows(k, per, s, work, fit->parameters); /* the rows are those of a step that was refused */
        find_products(rows, work, fit->gram);
        add_prior(k, per, &fit->prior, std, fit->parameters, fit->gram);
        return;
    }
}

/* Steps of Gauss and Newton without damping or limits, from fit->parameters: lost from bad starts (1.3), and then the
   start itself. */
static void fit_undamped(int64_t k, const Settings *s, const Limits *limits, Work *work) {
    const int64_t n = 3 * k, rows = n + 1, samples = work->window.n;
    const double std = work->window.std;
    const Limits none = {{-INFINITY, -INFINITY, -INFINITY, 0}, {INFINITY, INFINITY, INFINITY, 0}};
    Fit *fit = &work->fit;
    double *start = work->kept, *p = fit->parameters;
    memcpy(start, p, n * sizeof(double));
    fit->converged = fit->hopeless = 0;
    int is_sane = 1;
    for (int64_t iteration = 0; iteration < s->max_iterations && is_sane && !fit->converged; iteration++) {
        evaluate_rows(k, 3, s, work, p);
        find_products(rows, work, fit->gram);
        double promise = find_step(k, 3, work, p, fit->gram, &none, 0);
        for (int64_t i = 0; i < n; i++) work->step[i] *= unit_of(k, i, p, std);
        for (int64_t i = 0; i < n; i++) p[i] += work->step[i];
        for (int64_t j = 0; j < k; j++)
            is_sane &= p[j] > 0 && p[j] < limits->high[0] && p[2 * k + j] > LEAST_WIDTH && p[2 * k + j] < samples
                && p[k + j] > -samples && p[k + j] < 2 * samples;
        fit->converged = is_sane && promise < s->tolerance * std * std;
    }
    if (!is_sane) memcpy(p, start, n * sizeof(double));
    for (int64_t j = 2 * k; j < n; j++) p[j] = at_most(at_least(p[j], limits->low[2]), limits->high[2]);
    evaluate_rows(k, 3, s, work, p);
    find_products(rows, work, fit->gram);
    fit->cost = fit->gram[n * rows + n] / (std * std);
}

/* The inverse of the equations: variances, and what the width shares with amplitude and time; false if they are steep. */
INLINE int invert(int64_t k, int64_t per, Work *work, const double *gram, double *variance, double *shared) {
    const int64_t n = per * k, rows = n + 1;
    double *matrix = work->matrix;
    wide *column = (wide *)work->column;
    int is_flat = 1;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j <= i; j++) matrix[i * n + j] = gram[i * rows + j];
        matrix[i * n + i] = matrix[i * n + i] * (1 + RIDGE) + RIDGE + (i < k ? work->known[i] : 0);
    }
    factor(n, matrix, work->pivot, 1e-300);
    for (int64_t c = 0; c < n; c += LANES) {
        invert_columns(n, matrix, c, c + LANES > 2 * k ? 0 : c, column);
        for (int64_t i = c, q = 0; q < LANES && i < n; i++, q++) {
            variance[i] = column[i][q];
            is_flat &= variance[i] * gram[i * rows + i] < STEEP && variance[i] > 0;
            if (i / k == 2) { shared[i - 2 * k] = column[i - 2 * k][q]; shared[i - k] = column[i - k][q]; }
        }
    }
    return is_flat;
}

/* One standard deviation of each parameter and the covariances of widths, in float64 where echoes overlap much. */
INLINE void find_errors(int64_t k, int64_t per, Work *work, Solution *out) {
    const int64_t n = per * k, rows = n + 1, vectors = work->window.vectors;
    const double *p = work->fit.parameters, std = work->window.std;
    if (!invert(k, per, work, work->fit.gram, out->errors, out->shared)) {
        for (int64_t i = 0; i < n; i++) {
            const lanes *row = work->rows + i * vectors;
            for (int64_t j = 0; j <= i; j++) work->products[i * rows + j] = multiply_wide(vectors, row, work->rows + j * vectors);
            if (work->window.level_share > 0)
                take_level_off_products(work, i, multiply_wide(vectors, row, work->window.level), work->products + i * rows);
        }
        add_prior(k, per, &work->fit.prior, std, p, work->products);
        invert(k, per, work, work->products, out->errors, out->shared);
    }
    for (int64_t i = 0; i < n; i++) out->errors[i] = sqrt(at_least(out->errors[i], 0)) * unit_of(k, i, p, std) * std;
    for (int64_t i = 0; i < 2 * k; i++) out->shared[i] *= unit_of(k, i, p, std) * unit_of(k, 2 * k + i % k, p, std) * std * std;
}

/* `call` for the numbers of echoes that are common, so that their loops have constant ends, and for any other. */
#define FOR_EACH_NUMBER(call, ...) \
    (k == 1 && per == 3 ? call(1, 3, __VA_ARGS__) : k == 2 && per == 3 ? call(2, 3, __VA_ARGS__) : call(k, per, __VA_ARGS__))

static void fit_window(int64_t k, int64_t per, const Settings *s, const Limits *limits, const Prior *prior, double target, Work *work) {
    work->fit.k = k; work->fit.per = per; work->fit.prior = *prior;
    if (s->undamped) fit_undamped(k, s, limits, work);
    else FOR_EACH_NUMBER(fit_echoes, s, limits, target, work);
}

static const double NEAR = 4;                  /* widths of the pulse from an echo up to which what its fit leaves counts */

/* Root mean square residual in noise about each echo; that of its window where it is alone. */
static void measure_misfits(const Work *work, double reach, double *misfit) {
    const int64_t k = work->fit.k, n = work->fit.per * k;
    const Window *w = &work->window;
    const lanes *residual = work->rows + n * w->vectors;
    if (k == 1) misfit[0] = sqrt(at_least(work->fit.gram[n * (n + 1) + n], 0) / (w->used > 0 ? w->used : 1)) / w->std;
    for (int64_t j = 0; j < k && k > 1; j++) {
        const float time = work->fit.parameters[k + j];
        lanes squares = ALL(0), used = ALL(0);
        for (int64_t v = 0; v < w->vectors; v++) {
            const lanes away = w->x[v] - time;
            const lane_bits near = (away <= (float)reach) & (away >= (float)-reach) & (w->x[v] >= 0.f);
            squares += pick(near, residual[v] * residual[v], ALL(0));
            used += pick(near, ALL(1), ALL(0));
        }
        misfit[j] = sqrt(sum_lanes(squares) / at_least(sum_lanes(used), 1)) / w->std;
    }
}

/* The fit as a solution: errors, what is left of each echo, parameters that lie on their limits. The level is taken off the
   residual, not off the other rows. */
static void describe_fit(const Settings *s, const Limits *limits, Work *work, Solution *out) {
    const int64_t k = work->fit.k, per = work->fit.per;
    FOR_EACH_NUMBER(find_errors, work, out);
    take_level_off(&work->window, 1, work->rows + per * k * work->window.vectors);
    measure_misfits(work, NEAR * s->width_ref, out->misfit);
    out->k = k; out->per = per; out->converged = work->fit.converged; out->cost = work->fit.cost;
    memcpy(out->parameters, work->fit.parameters, per * k * sizeof(double));
    memset(out->at_bound, 0, k);
    for (int64_t q = 0, i = 0; q < per; q++)
        for (int64_t j = 0; j < k; j++, i++) out->at_bound[j] |= out->parameters[i] <= limits->low[q] || out->parameters[i] >= limits->high[q];
}
