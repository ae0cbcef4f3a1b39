/* Does the residual hold more than noise, and where would one more echo explain most? docs/algorithms.md 2.3, 4.2. */

static const double SMOOTH_GAIN = 0.61237243569579452; /* of white noise through [1 2 1]/4 */
static const double HERMITE_REACH = 5;         /* widths: beyond, the pulse is zero */
static const double FINE = 16;                 /* taps of a width that are enough: lines between them miss 5e-4 of the top */
static const double LEAST_PIVOT = 1e-7;        /* below is what rounding of float32 products leaves */
static const double LEAST_SHAPE = 1e-3;        /* share of a moment's direction that the fit must leave */
static const double LEAST_NEW = 0.03;          /* share of a new echo's energy that the present ones must leave */

/* The equations of a fit for `factor`, in work->matrix. */
static void set_equations(const Fit *fit, Work *work) {
    const int64_t p = 3 * fit->k;
    for (int64_t i = 0; i < p; i++) {
        for (int64_t j = 0; j <= i; j++) work->matrix[i * p + j] = fit->gram[i * (p + 1) + j];
        work->matrix[i * p + i] = work->matrix[i * p + i] * (1 + RIDGE) + RIDGE;
    }
}

/* The next two directions after the three that a fit of an echo removes: (8 z^3 - 12 z) e and (16 z^4 - 48 z^2 + 12) e. */
INLINE void find_directions(const Window *w, float time, float inverse, Basis row, int weighed, lanes *third, lanes *fourth) {
    for (int64_t v = 0; v < w->vectors; v++) {
        const lanes z = least_of(most_of((w->x[v] - time) * inverse, ALL(-HERMITE_REACH)), ALL(HERMITE_REACH));
        const lanes once = row.by_width[v] * z, twice = once * z;
        const lanes weight = weighed && w->is_weighted ? w->weight[v] : ALL(1);
        third[v] = (once * 8.f - row.by_time[v] * 12.f) * weight;
        fourth[v] = (twice * 16.f - row.by_width[v] * 48.f + row.pulse[v] * 12.f) * weight;
    }
}

/* Gauss-Hermite moments h3, h4 of the residual around each echo: N(0, 1) if the fit is right. */
static void hermite_moments(Work *work, const Fit *fit) {
    const Window *w = &work->window;
    const int64_t k = fit->k, n = w->vectors;
    const lanes *residual = work->rows + 3 * k * n;
    lanes *third = work->about + 3 * n, *fourth = work->about + 4 * n;
    for (int64_t j = 0; j < k; j++) {
        const float time = fit->parameters[k + j], inverse = 1 / fit->parameters[2 * k + j];
        const Basis row = {work->rows + j * n, work->rows + (k + j) * n, work->rows + (2 * k + j) * n, NULL};
        find_directions(w, time, inverse, row, 0, third, fourth);
        take_level_off(w, 1, third);
        take_level_off(w, 1, fourth);
        lanes sum[4] = {{0}};
        for (int64_t v = 0; v < n; v++) {
            sum[0] += third[v] * residual[v]; sum[1] += third[v] * third[v];
            sum[2] += fourth[v] * residual[v]; sum[3] += fourth[v] * fourth[v];
        }
        const lanes product = sum_four(sum[0], sum[1], sum[2], sum[3]);
        work->h3[j] = product[0] / sqrt(at_least(product[1], 1e-12)) / w->std;
        work->h4[j] = product[2] / sqrt(at_least(product[3], 1e-12)) / w->std;
    }
}

/* Takes off a direction what the rows of the fit, factorised, have of it. */
static void take_rows_off(Work *work, int64_t p, lanes *direction) {
    const int64_t n = work->window.vectors;
    double *share = work->column;
    for (int64_t i = 0; i < p; i++) share[i] = multiply(n, work->rows + i * n, direction);
    solve(p, work->matrix, share);
    for (int64_t i = 0; i < p; i++) {
        const float part = share[i];
        for (int64_t v = 0; v < n; v++) direction[v] -= work->rows[i * n + v] * part;
    }
}

/* The same where noise is whitened: the two directions are, too, and then what the fit removes is taken off them. */
static void whitened_moments(const Settings *s, Work *work, const Fit *fit) {
    const Window *w = &work->window;
    const int64_t k = fit->k, p = 3 * k, n = w->vectors;
    const lanes *residual = work->rows + p * n;
    lanes *third = work->about + 3 * n, *fourth = work->about + 4 * n;
    Basis row = {work->about, work->about + n, work->about + 2 * n, third};
    set_equations(fit, work);
    factor(p, work->matrix, work->pivot, LEAST_PIVOT);
    for (int64_t i = 0; i < p; i++) take_level_off(w, 1, work->rows + i * n);
    for (int64_t j = 0; j < k; j++) {
        const Echo echo = {fit->parameters[j], fit->parameters[k + j], fit->parameters[2 * k + j], 0};
        const float time = echo.time, inverse = 1 / echo.width;
        evaluate_pulse(&s->pulse, 0, &echo, w->x, n, row);
        find_directions(w, time, inverse, row, 1, third, fourth);
        double *moment[] = {work->h3 + j, work->h4 + j};
        for (int q = 0; q < 2; q++) {
            lanes *direction = q ? fourth : third;
            whiten(w, direction);
            take_level_off(w, 1, direction);
            const double all = multiply(n, direction, direction);
            take_rows_off(work, p, direction);
            if (q) {
                const float share = multiply(n, third, fourth) / at_least(multiply(n, third, third), 1e-12);
                for (int64_t v = 0; v < n; v++) fourth[v] -= third[v] * share;
            }
            const double left = multiply(n, direction, direction);
            *moment[q] = left > LEAST_SHAPE * all ? multiply(n, direction, residual) / sqrt(left) / w->std : 0;
        }
    }
}

/* Energy of a whitened new pulse at each sample of the window; the same wherever no gap is near, and near the ends of
   all windows without gaps and weights. */
static void find_new_energy(Work *work) {
    const Window *w = &work->window;
    const int64_t room = w->vectors * LANES, reach = work->reach, plain = !w->is_weighted && !w->any_clipped && w->used == w->n;
    const float *filter = (const float *)w->filter, *weight = (const float *)w->weight;
    const int64_t edge = reach + 3, last = w->n - 1, is_long = plain && w->n > 2 * edge;
    float *energy = (float *)work->new_energy, *begin = work->edges, *end = begin + edge + 1;
    for (int64_t t = 0; t <= last && is_long && work->has_edges; t++)
        energy[t] = t < edge ? begin[t] : last - t < edge ? end[last - t] : begin[edge];
    if (is_long && work->has_edges) return;
    for (int64_t t = 0; t < room; t++) {
        float sum = 0;
        for (int64_t i = t > reach ? t - reach : 0; i <= t + reach + 2 && i < w->n; i++) {
            float value = 0;
            for (int64_t j = 0; j < 3 && j <= i; j++) {
                int64_t away = i - j < t ? t - i + j : i - j - t;
                if (away <= reach) value += filter[j * room + i] * work->taps[away] * (w->is_weighted ? weight[i - j] : 1);
            }
            sum += value * value;
        }
        energy[t] = sum;
    }
    for (int64_t t = 0; t <= edge && is_long; t++) { begin[t] = energy[t]; end[t] = energy[last - t]; }
    work->has_edges |= is_long;
}

static void correlate(const Work *work, const lanes *row, const float *taps, lanes *out);

/* Whether a new pulse finds more in the whitened residual than noise explains, or the moments do. */
static int is_whitened_misfit(const Settings *s, Work *work, const Fit *fit) {
    const Window *w = &work->window;
    const float *share = (const float *)work->about, *energy = (const float *)work->new_energy;
    double shape = 0, highest = 0;
    for (int64_t j = 0; j < fit->k; j++) shape = at_least(work->h3[j] * work->h3[j] + work->h4[j] * work->h4[j], shape);
    filter_back(w, work->rows + 3 * fit->k * w->vectors, work->back);
    correlate(work, work->back, work->taps, work->about);
    for (int64_t i = 1; i + 1 < w->n; i++)
        if (share[i] > 0 && energy[i] > 0) highest = at_least((double)share[i] * share[i] / energy[i], highest);
    return highest > s->gate_residual * s->gate_residual * w->std * w->std || shape > s->gate_hermite;
}

/* Whether the smoothed residual or its moments exceed what noise explains. Needs hermite_moments. */
static int is_misfit(const Settings *s, Work *work, const Fit *fit) {
    const Window *w = &work->window;
    const float *residual = (const float *)(work->rows + 3 * fit->k * w->vectors);
    double shape = 0;
    float highest = 0;
    for (int64_t i = 1; i + 1 < w->n; i++) {
        const float height = residual[i - 1] + residual[i + 1] + 2 * residual[i];
        highest = height > highest ? height : highest;
    }
    for (int64_t j = 0; j < fit->k; j++) shape = at_least(work->h3[j] * work->h3[j] + work->h4[j] * work->h4[j], shape);
    return 0.25 * highest > s->gate_residual * SMOOTH_GAIN * w->std || shape > s->gate_hermite;
}

/* Half of a Gaussian of height 1 with the width of a new echo, up to three widths, and after it the same squared; a tap
   for each `stride` samples. No more than a waveform is long: else a width out of proportion would take all memory. */
static int make_taps(Work *work, const Settings *s, int64_t length) {
    work->stride = s->whitened ? 1 : (int64_t)fmin(fmax(1, s->width_ref / FINE), length);
    work->reach = (int64_t)ceil(fmin(3 * s->width_ref, length) / work->stride);
    if (!enlarge(&work->taps, 2 * (work->reach + 1) * sizeof(float))) return 0;
    if (!enlarge(&work->edges, 2 * (work->reach + 4) * sizeof(float))) return 0;
    for (int64_t i = 0; i <= work->reach; i++) {
        double z = i * work->stride / s->width_ref, tap = exp_lanes(ALL(-0.5 * z * z))[0];
        work->taps[i] = tap;
        work->taps[work->reach + 1 + i] = tap * tap;
    }
    return 1;
}

/* A row of n vectors correlated with symmetric taps, 0 outside of it. */
static void correlate_each(const Work *work, const lanes *row, int64_t n, const float *taps, lanes *out) {
    enum { TOGETHER = 4 }; /* a sum waits for each of its additions, so there are four at a time */
    const int64_t before = VECTORS(work->reach) + TOGETHER;
    float *padded = (float *)work->padded;
    memset(padded, 0, before * sizeof(lanes));
    memcpy(padded + before * LANES, row, n * sizeof(lanes));
    memset(padded + (before + n) * LANES, 0, before * sizeof(lanes));
    for (int64_t v = 0; v < n; v += TOGETHER) {
        const float *here = padded + (before + v) * LANES;
        lanes sum[TOGETHER], left, right;
        for (int q = 0; q < TOGETHER; q++) {
            memcpy(&left, here + q * LANES, sizeof left);
            sum[q] = left * taps[0];
        }
        for (int64_t i = 1; i <= work->reach; i++)
            for (int q = 0; q < TOGETHER; q++) {
                memcpy(&left, here + q * LANES - i, sizeof left);
                memcpy(&right, here + q * LANES + i, sizeof right);
                sum[q] += (left + right) * taps[i];
            }
        memcpy(out + v, sum, (n - v < TOGETHER ? n - v : TOGETHER) * sizeof(lanes));
    }
}

/* A row of the window correlated with symmetric taps, 0 outside. With a wide pulse the sums of `stride` samples are, and
   values between them lie on lines: the work would grow with the square of the width. */
static void correlate(const Work *work, const lanes *row, const float *taps, lanes *out) {
    const int64_t n = work->window.vectors, room = n * LANES, stride = work->stride, few = (room + stride - 1) / stride;
    const float *number = (const float *)row;
    float *value = (float *)out, *sums = (float *)work->coarse;
    if (stride == 1) { correlate_each(work, row, n, taps, out); return; }
    memset(sums, 0, VECTORS(few) * sizeof(lanes));
    for (int64_t i = 0; i < room; i++) sums[i / stride] += number[i];
    correlate_each(work, work->coarse, VECTORS(few), taps, work->coarse);
    for (int64_t i = 0; i < room; i++) {
        const int64_t twice = 2 * i + 1 - stride, part = twice > 0 ? twice / (2 * stride) : 0, next = part + 1 < few ? part + 1 : part;
        const float share = (float)(twice - 2 * part * stride) / (2 * stride);
        value[i] = sums[part] + (sums[next] - sums[part]) * share;
    }
}

/* What a new echo at each sample would have in common with none of the present ones: its energy, and its share of the
   residual, by taking off the rows of the factorised equations one after the other. */
static void project_out(Work *work, const Fit *fit, lanes *energy, lanes *onto) {
    const int64_t p = 3 * fit->k, n = work->window.vectors;
    double *lower = work->matrix, *right = work->step;
    set_equations(fit, work);
    for (int64_t i = 0; i < p; i++) right[i] = fit->gram[p * (p + 1) + i];
    factor(p, lower, work->pivot, LEAST_PIVOT);
    for (int64_t i = 0; i < p; i++) {
        lanes *row = work->about + i * n;
        for (int64_t j = 0; j < i; j++) {
            const float share = lower[i * p + j];
            right[i] -= lower[i * p + j] * right[j];
            for (int64_t v = 0; v < n; v++) row[v] -= work->about[j * n + v] * share;
        }
        const float inverse = 1 / work->pivot[i], rest = right[i];
        for (int64_t v = 0; v < n; v++) {
            lanes share = row[v] * inverse;
            energy[v] -= share * row[v];
            onto[v] -= share * rest;
        }
    }
}

/* One echo as two where its top is too flat: no single new echo can flatten a top. The pair leaves h4 < 0, and
   h3^2 + h4^2 is the fall of chi2 that it promises; it is taken where that is more. */
static double split_flat(const Settings *s, const Work *work, const Fit *fit, double promise, Fit *next) {
    const int64_t k = fit->k;
    const double *p = fit->parameters;
    int64_t echo = -1;
    for (int64_t j = 0; j < k; j++) {
        double gain = work->h4[j] < 0 ? work->h3[j] * work->h3[j] + work->h4[j] * work->h4[j] : 0;
        if (gain > promise) { promise = gain; echo = j; }
    }
    if (echo < 0) return promise;
    double amplitude = p[echo], time = p[k + echo], broad = p[2 * k + echo], narrow = at_most(broad, 1.1 * s->width_ref);
    double apart = at_least(sqrt(broad * broad - narrow * narrow), 0.5 * broad), half = 0.5 * amplitude * broad / narrow;
    double first[3] = {half, time - apart, narrow}, second[3] = {half, time + apart, narrow};
    for (int64_t q = 0; q < 3; q++) {
        memcpy(next->parameters + q * (k + 1), p + q * k, k * sizeof(double));
        next->parameters[q * (k + 1) + echo] = first[q];
        next->parameters[q * (k + 1) + k] = second[q];
    }
    return promise;
}

/* The best new echo: the start of the larger fit, and the fall of chi2 that it promises. One Gauss-Newton step in which
   the new amplitude starts at zero. Needs hermite_moments. */
static double propose_echo(const Settings *s, Work *work, const Fit *fit, const Limits *limits, Fit *next) {
    const Window *w = &work->window;
    const int64_t k = fit->k, p = 3 * k, n = w->vectors;
    lanes *onto = work->about + p * n;
    for (int64_t i = 0; i <= p; i++) {
        /* Twice in all: new pulses keep their share of it. */
        take_level_off(w, w->is_whitened || i == p ? 1 : 2 - w->level_share, work->rows + i * n);
        if (w->is_whitened) filter_back(w, work->rows + i * n, work->back);
        correlate(work, w->is_whitened ? work->back : work->rows + i * n, work->taps, work->about + i * n);
    }
    for (int64_t v = 0; v < n; v++) work->rows[v] = pick(w->x[v] >= 0.f, ALL(1), ALL(0)); /* the pulses are not needed any more */
    if (w->is_whitened) memcpy(work->energy, work->new_energy, n * sizeof(lanes));
    else correlate(work, work->rows, work->taps + work->reach + 1, work->energy);
    if (w->level_share > 0) {
        if (w->is_whitened) filter_back(w, w->level, work->back);
        correlate(work, w->is_whitened ? work->back : w->level, work->taps, work->rows);
        for (int64_t v = 0; v < n; v++) work->energy[v] -= work->rows[v] * work->rows[v] * (float)(2 - w->level_share);
    }
    float most = 0, *left = (float *)work->energy;
    for (int64_t i = 0; i < w->n; i++) most = left[i] > most ? left[i] : most;
    project_out(work, fit, work->energy, onto);
    int64_t place = 0;
    double best = 0, amplitude = 0;
    for (int64_t i = 0; i < w->n; i++) {
        float share = ((float *)onto)[i];
        if (!(left[i] > LEAST_NEW * most && share > 0 && ((const float *)w->x)[i] >= 0)) continue;
        double score = (double)share * share / left[i];
        if (score > best) { best = score; place = i; amplitude = share / left[i]; }
    }
    double *change = work->column;
    for (int64_t i = 0; i < p; i++) change[i] = ((float *)(work->about + i * n))[place] / work->pivot[i];
    for (int64_t i = p - 1; i >= 0; i--)
        for (int64_t j = i + 1; j < p; j++) change[i] -= work->matrix[j * p + i] * change[j];
    next->k = k + 1; next->per = 3;
    for (int64_t j = 0; j < k; j++) {
        double a = fit->parameters[j], time = fit->parameters[k + j], width = fit->parameters[2 * k + j];
        double unit = -amplitude * unit_of(k, k + j, fit->parameters, w->std);
        next->parameters[j] = at_least(a - change[j] * amplitude, 0.2 * a);
        next->parameters[k + 1 + j] = time + at_most(at_least(change[k + j] * unit, -s->width_ref), s->width_ref);
        next->parameters[2 * k + 2 + j] = width + at_most(at_least(change[2 * k + j] * unit, -0.4 * width), 0.3 * width);
    }
    next->parameters[k] = amplitude; next->parameters[2 * k + 1] = place; next->parameters[3 * k + 2] = s->width_ref;
    double promise = split_flat(s, work, fit, best / (w->std * w->std), next);
    for (int64_t i = 0; i < 3 * k + 3; i++)
        next->parameters[i] = at_most(at_least(next->parameters[i], limits->low[i / (k + 1)]), limits->high[i / (k + 1)]);
    return promise;
}
