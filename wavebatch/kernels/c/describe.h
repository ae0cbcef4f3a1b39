/* How long the description of waveforms is with their echoes, and the pulse that all echoes of a sample ask for: the
   survey's judge and its learning, docs/algorithms.md R2. Plain loops, one waveform after the other. */

static const double FREEDOM = 4;               /* of Student's law: what no pulse explains must not decide */
static const double NEARLY_SINGULAR = 1e-6;    /* of a scaled matrix, which is no better known in float32 */
static const double PEAK = 0.83698821678583584; /* -ln of Student's density at 0, of a scale of root 3/4 */
static const double ROOT_2PI_INVERSE = 0.39894228040143268; /* one over the root of 2 pi */
static const double REACH = 6;                 /* widths beyond which nothing of a Gaussian is left */
static const double NARROWEST = 0.1;           /* variance of a Gaussian under an echo narrower than the pulse, over its own */
enum { CHANGED = 3, TOGETHER = 6 };            /* strongest echoes of a waveform whose shapes may change; echoes whose errors
                                                  are taken together, so that time grows with their number */

typedef struct { /* n waveforms of `length` samples, and their echoes: first[i] .. first[i + 1] - 1 are those of waveform i */
    int64_t n, length;
    const float *left, *model;                 /* samples less level and model; sum of the echoes */
    const uint8_t *used;                       /* samples that count */
    const int64_t *first;
    const double *amplitude, *time, *width;    /* of the pulse's main component [samples] */
    Pulse pulse;
    double variance, gain;                     /* noise of a sample, and its growth with the signal */
    double change;                             /* of the pulse from shot to shot, as a share of its amplitude */
    double ahead[2], left_over;                /* prediction from the last two samples, variance that it leaves */
} Described;

typedef struct {
    int64_t vectors;
    lanes *x, *weight, *rest, *rows, *modes;
    double *gram, *matrix, *pivot, *column;
} Desk;

static int furnish(Desk *d, int64_t rows, int64_t vectors) {
    const size_t row = vectors * sizeof(lanes), n = rows;
    d->vectors = vectors;
    return enlarge(&d->x, row) && enlarge(&d->weight, row) && enlarge(&d->rest, row) && enlarge(&d->rows, n * row)
        && enlarge(&d->modes, (6 + 2 * CHANGED) * row) && enlarge(&d->gram, n * n * sizeof(double)) && enlarge(&d->matrix, n * n * sizeof(double))
        && enlarge(&d->pivot, n * sizeof(double)) && enlarge(&d->column, n * sizeof(wide));
}

static void clear_desk(Desk *d) {
    free(d->x); free(d->weight); free(d->rest); free(d->rows); free(d->modes);
    free(d->gram); free(d->matrix); free(d->pivot); free(d->column);
}

/* Positions of the samples that count, OUTSIDE for others; their weights, one over the noise; and what is left, in noise.
   Returns the sum of the logarithms of the noises. */
static double lay_out(const Described *w, int64_t i, Desk *d) {
    float *x = (float *)d->x, *weight = (float *)d->weight, *rest = (float *)d->rest;
    const int64_t begin = i * w->length;
    double sum = 0, inverse = 1 / sqrt(w->variance), size = 0.5 * log_double(w->variance * w->left_over);
    for (int64_t t = 0; t < d->vectors * LANES; t++) {
        int counts = t < w->length && w->used[begin + t];
        if (counts && w->gain > 0) {
            double variance = w->variance + w->gain * at_least(w->model[begin + t], 0);
            inverse = 1 / sqrt(variance);
            size = 0.5 * log_double(variance * w->left_over);
        }
        x[t] = counts ? t : OUTSIDE;
        weight[t] = counts ? inverse : 0;
        rest[t] = counts ? w->left[begin + t] * weight[t] : 0;
        if (counts) sum += size;
    }
    return sum;
}

/* What the two samples before do not predict, in place. From the end, so that what is still needed is not yet changed. */
static void innovate(const Described *w, lanes *row, int64_t vectors) {
    const float *y = (float *)row;
    const float one = w->ahead[0], two = w->ahead[1], scale = 1 / sqrt(w->left_over);
    lanes last, before;
    for (int64_t v = vectors - 1; v > 0; v--) {
        memcpy(&last, y + v * LANES - 1, sizeof(lanes));
        memcpy(&before, y + v * LANES - 2, sizeof(lanes));
        row[v] = (row[v] - last * one - before * two) * scale;
    }
    float shifted[LANES + 2] = {0, 0};
    memcpy(shifted + 2, y, sizeof(lanes));
    memcpy(&last, shifted + 1, sizeof(lanes));
    memcpy(&before, shifted, sizeof(lanes));
    row[0] = (row[0] - last * one - before * two) * scale;
}

/* Rows of an echo at the positions x: pulse, and derivatives by time and width. */
static void draw_echo(const Described *w, int64_t echo, const lanes *x, int64_t vectors, lanes *rows) {
    Echo one = {1, w->time[echo], w->width[echo], 0};
    Basis basis = {rows, rows + vectors, rows + 2 * vectors, NULL};
    evaluate_pulse(&w->pulse, 0, &one, x, vectors, basis);
}

/* How far a pulse of this width reaches before and after its time [samples]. */
static void find_reach(const Pulse *shape, double width, double *before, double *after) {
    *before = *after = (shape->kind == SUM_OF_GAUSSIANS ? REACH : 4 * REACH) * width;
    for (int64_t c = 0; c < shape->n_components; c++) {
        const double *part = shape->components + 3 * c, wide = REACH * sqrt(width * width + part[2]);
        *before = at_least(wide - part[1], *before);
        *after = at_least(wide + part[1], *after);
    }
}

/* Vectors that k echoes reach, the first of them in `from`. */
static int64_t find_vectors(const Described *w, int64_t first, int64_t k, int64_t *from) {
    double low = INFINITY, high = -INFINITY;
    for (int64_t j = first; j < first + k; j++) {
        double before, after;
        find_reach(&w->pulse, w->width[j], &before, &after);
        low = at_most(w->time[j] - before, low);
        high = at_least(w->time[j] + after, high);
    }
    *from = at_most(at_least(low, 0), w->length - 1) / LANES;
    return VECTORS((int64_t)at_most(at_least(high, 0), w->length - 1) + 1) - *from;
}

/* Half the negative logarithm of the determinant of the correlations of all that is fitted of k echoes: those that share
   their samples are worth less than their errors say. */
static double shared_volume(const Described *w, Desk *d, int64_t first, int64_t k) {
    int64_t from;
    const int64_t p = 3 * k, vectors = find_vectors(w, first, k, &from);
    double sum = 0;
    for (int64_t j = 0; j < k; j++) draw_echo(w, first + j, d->x + from, vectors, d->rows + 3 * j * vectors);
    for (int64_t r = 0; r < p; r++) {
        lanes *row = d->rows + r * vectors;
        for (int64_t v = 0; v < vectors; v++) row[v] *= d->weight[from + v];
        innovate(w, row, vectors);
    }
    multiply_rows(p, vectors, d->rows, d->gram);
    for (int64_t r = 0; r < p; r++) d->column[r] = 1 / sqrt(at_least(d->gram[r * p + r], 1e-12));
    for (int64_t r = 0; r < p; r++)
        for (int64_t c = 0; c <= r; c++)
            d->matrix[r * p + c] = d->gram[r * p + c] * d->column[r] * d->column[c] + (r == c ? NEARLY_SINGULAR : 0);
    factor(p, d->matrix, d->pivot, 0.1 * NEARLY_SINGULAR);
    for (int64_t r = 0; r < p; r++) {
        const int64_t q = r % LANES;
        if (!q) invert_columns(p, d->matrix, r, r, (wide *)d->column);
        sum += 0.5 * (log_double(at_least(d->column[LANES * r + q], 1)) + log_double(at_most(d->pivot[r], 2)));
    }
    return sum;
}

typedef struct { int64_t from, vectors; lanes *rows; double energy[2]; } Bend;

/* Two directions in which an echo's shape may change, the next after those of the fit as in `hermite_moments`, as they
   are seen in innovations of the noise; and their energies. */
static void find_bend(const Described *w, Desk *d, int64_t echo, Bend *bend) {
    const int64_t vectors = bend->vectors = find_vectors(w, echo, 1, &bend->from);
    const lanes *x = d->x + bend->from, *weight = d->weight + bend->from;
    const float time = w->time[echo], inverse = 1 / w->width[echo];
    double energy = 0;
    draw_echo(w, echo, x, vectors, d->modes);
    for (int64_t v = 0; v < vectors; v++) {
        lanes z = least_of(most_of((x[v] - time) * inverse, ALL(-HERMITE_REACH)), ALL(HERMITE_REACH));
        d->modes[3 * vectors + v] = d->modes[2 * vectors + v] * z;
        d->modes[4 * vectors + v] = d->modes[3 * vectors + v] * z;
    }
    for (int64_t r = 0; r < 5; r++) {
        lanes *row = d->modes + r * vectors;
        for (int64_t b = 0; b < r; b++) {
            const float share = multiply(vectors, row, d->modes + b * vectors);
            for (int64_t v = 0; v < vectors; v++) row[v] -= d->modes[b * vectors + v] * share;
        }
        double norm = sqrt(multiply(vectors, row, row));
        if (!r) energy = norm;
        for (int64_t v = 0; v < vectors; v++) row[v] *= (float)(1 / at_least(norm, 1e-9));
    }
    for (int64_t r = 0; r < 2; r++) {
        lanes *row = bend->rows + r * vectors;
        for (int64_t v = 0; v < vectors; v++) row[v] = d->modes[(3 + r) * vectors + v] * (weight[v] * (float)(energy * w->amplitude[echo]));
        innovate(w, row, vectors);
        bend->energy[r] = multiply(vectors, row, row);
    }
}

static const double UNBOUND = 1e3;             /* change of a shape that bounds nothing */

/* Height of a direction in what is left, where a change of the pulse from shot to shot makes so much likely. */
static double find_height(const Bend *bend, int64_t r, const lanes *rest, double change) {
    return multiply(bend->vectors, bend->rows + r * bend->vectors, rest + bend->from) / (bend->energy[r] + 1 / (change * change));
}

/* Takes a change of an echo's shape off what is left, as far as it is likely, and returns what it costs. */
static double change_shape(const Bend *bend, double change, lanes *rest) {
    double cost = 0;
    for (int64_t r = 0; r < 2; r++) {
        const double height = find_height(bend, r, rest, change);
        for (int64_t v = 0; v < bend->vectors; v++) rest[bend->from + v] -= bend->rows[r * bend->vectors + v] * (float)height;
        cost += 0.5 * (height / change) * (height / change) + 0.5 * log_double(1 + change * change * bend->energy[r]);
    }
    return cost;
}

/* The strongest echo of a waveform that is weaker than `last`, or its first equal after `at`; -1 where there is none. */
static int64_t next_strongest(const Described *w, int64_t first, int64_t end, int64_t last) {
    int64_t best = -1;
    for (int64_t j = first; j < end; j++) {
        int later = last < 0 || w->amplitude[j] < w->amplitude[last] || (w->amplitude[j] == w->amplitude[last] && j > last);
        if (later && (best < 0 || w->amplitude[j] > w->amplitude[best])) best = j;
    }
    return best;
}

/* Length of what the echoes leave of each waveform by Student's law [nats]. */
static double measure_rest(const Described *w, int64_t i, const float *rest) {
    double sum = 0, product = 1;
    for (int64_t t = 0; t < w->length; t++) {
        if (!w->used[i * w->length + t]) continue;
        product *= 1 + (double)rest[t] * rest[t] / (0.75 * FREEDOM);
        if (product > 1e200) { sum += 0.5 * (FREEDOM + 1) * log_double(product); product = 1; }
        sum += PEAK;
    }
    return sum + 0.5 * (FREEDOM + 1) * log_double(product);
}

/* Length of what the echoes leave of each waveform, with what its shapes cost, for each of `number` changes of the pulse,
   (number, n); and the volume that echoes share, (n). Unless NULL: change of the shape of the strongest echo in two
   directions, as a share of its amplitude, and one over the variance of each, (n, 2); 0 where there is no echo. */
EXPORT int64_t describe_waveforms(const Described *w, int64_t number, const double *changes, double *length, double *volume,
                                  double *heights, double *energies) {
    Desk d = {0};
    Bend bends[CHANGED];
    const int64_t vectors = VECTORS(w->length);
    int good = furnish(&d, 3 * TOGETHER, vectors), most = heights ? 1 : 0;
    for (int64_t c = 0; c < number; c++) most = changes[c] > 0 ? CHANGED : most;
    for (int64_t i = 0; i < w->n && good; i++) {
        const int64_t first = w->first[i], end = w->first[i + 1];
        const double sum = lay_out(w, i, &d);
        lanes *rest = d.modes + 5 * vectors;
        int64_t bent = 0, echo = -1;
        innovate(w, d.rest, vectors);
        for (; bent < most && (echo = next_strongest(w, first, end, echo)) >= 0; bent++) {
            bends[bent].rows = d.modes + (6 + 2 * bent) * vectors;
            find_bend(w, &d, echo, bends + bent);
        }
        for (int64_t r = 0; heights && r < 2; r++) {
            heights[2 * i + r] = bent ? find_height(bends, r, d.rest, UNBOUND) : 0;
            energies[2 * i + r] = bent ? bends->energy[r] : 0;
        }
        for (int64_t c = 0; c < number; c++) {
            double cost = sum;
            memcpy(rest, d.rest, vectors * sizeof(lanes));
            for (int64_t j = 0; changes[c] > 0 && j < bent; j++) cost += change_shape(bends + j, changes[c], rest);
            length[c * w->n + i] = cost + measure_rest(w, i, (const float *)rest);
        }
        volume[i] = 0;
        for (int64_t j = first; j < end; j += TOGETHER) volume[i] += shared_volume(w, &d, j, end - j < TOGETHER ? end - j : TOGETHER);
    }
    clear_desk(&d);
    return good ? 0 : -1;
}

enum { LEARNED = 15 };                         /* rounds after which shares of laws hardly move */

/* Shares of normal values below z, exact to 2e-7 (Abramowitz and Stegun 26.2.17). */
INLINE lanes normal_below(lanes z) {
    const lanes size = least_of(most_of(z, -z), ALL(6)), t = 1 / (1 + 0.2316419f * size);
    const lanes series = t * (0.319381530f + t * (-0.356563782f + t * (1.781477937f + t * (-1.821255978f + t * 1.330274429f))));
    const lanes above = exp_lanes(size * size * -0.5f) * series * (float)ROOT_2PI_INVERSE;
    return pick(z > 0, 1 - above, above);
}

/* Density of a width by each law through its error: the pulse's own width, and uniform ones from there up to the ends;
   spans: one over what those cover, 0 for the first and for what fills up. */
static void weigh_laws(double ratio, double error, int64_t vectors, const lanes *ends, const lanes *spans, lanes *density) {
    const float inverse = 1 / error, z = (ratio - 1) / error, beyond = ratio - 1;
    const float below = normal_below(ALL(z))[0];
    for (int64_t v = 0; v < vectors; v++) density[v] = (below - normal_below((beyond - ends[v]) * inverse)) * spans[v];
    density[0][0] = exp_lanes(ALL(-0.5f * fminf(z * z, 160)))[0] * (float)ROOT_2PI_INVERSE * inverse;
}

/* Cost of each of n widths [nats] by the sum of laws that makes the known ones likeliest, with the scatter beyond their
   errors that serves best; a share `anywhere` of them lies anywhere up to the widest. */
EXPORT int64_t describe_widths(int64_t n, const double *ratio, const double *error, const uint8_t *known, int64_t scatters,
                               const double *scatter, int64_t uniform, const double *wider, double anywhere, double *cost) {
    const int64_t laws = uniform + 1, vectors = VECTORS(laws);
    lanes *density = calloc((n + 4) * vectors, sizeof(lanes)), *share = density + n * vectors, *next = share + vectors;
    lanes *ends = next + vectors, *spans = ends + vectors;
    double *tried = malloc((n + 1) * sizeof(double)), least = INFINITY;
    if (!density || !tried) { free(density); free(tried); return -1; }
    for (int64_t k = 1; k < laws; k++) {
        ends[k / LANES][k % LANES] = wider[k - 1] - 1;
        spans[k / LANES][k % LANES] = 1 / (wider[k - 1] - 1);
    }
    for (int64_t s = 0; s < scatters; s++) {
        double sum = 0, number = 0;
        for (int64_t i = 0; i < n; i++) {
            weigh_laws(ratio[i], sqrt(error[i] * error[i] + scatter[s] * scatter[s]), vectors, ends, spans, density + i * vectors);
            number += known[i];
        }
        for (int64_t k = 0; k < laws; k++) share[k / LANES][k % LANES] = 1.0 / laws;
        for (int round = 0; round < LEARNED; round++) {
            memset(next, 0, vectors * sizeof(lanes));
            for (int64_t i = 0; i < n; i++) {
                if (!known[i]) continue;
                const lanes *own = density + i * vectors;
                const float whole = 1 / (float)at_least(multiply(vectors, own, share), 1e-30f);
                for (int64_t v = 0; v < vectors; v++) next[v] += own[v] * whole;
            }
            for (int64_t v = 0; v < vectors; v++) share[v] = (next[v] * share[v] + 0.5f) * (float)(1 / (number + 0.5 * laws));
        }
        for (int64_t i = 0; i < n; i++) {
            const double whole = multiply(vectors, density + i * vectors, share);
            tried[i] = -log_double((1 - anywhere) * whole + anywhere / wider[uniform - 1]);
            if (known[i]) sum += tried[i];
        }
        if (!(sum < least)) break; /* further ones serve worse still */
        least = sum;
        memcpy(cost, tried, n * sizeof(double));
    }
    for (int64_t i = 0; i < n; i++) cost[i] -= log_double(error[i] / ROOT_2PI_INVERSE);
    free(density); free(tried);
    return 0;
}

/* Directions in which amplitudes and times of a waveform's echoes move its weighted samples: orthonormal, two for each
   echo; 0 where others span one. A row more is drawn. */
static void find_moves(const Described *w, const Desk *d, int64_t first, int64_t end, lanes *moves) {
    const int64_t vectors = d->vectors;
    for (int64_t j = first; j < end; j++) draw_echo(w, j, d->x, vectors, moves + 2 * (j - first) * vectors);
    for (int64_t r = 0; r < 2 * (end - first); r++) {
        lanes *row = moves + r * vectors;
        for (int64_t v = 0; v < vectors; v++) row[v] *= d->weight[v];
        const double whole = multiply(vectors, row, row);
        for (int64_t b = 0; b < r; b++) {
            const float share = multiply(vectors, row, moves + b * vectors);
            for (int64_t v = 0; v < vectors; v++) row[v] -= moves[b * vectors + v] * share;
        }
        const double left = multiply(vectors, row, row);
        const float scale = left > NEARLY_SINGULAR * whole ? 1 / sqrt(left) : 0;
        for (int64_t v = 0; v < vectors; v++) row[v] *= scale;
    }
}

/* Normal equations of a pulse that is a sum of `number` Gaussians of given delays and variances, and of an offset of the
   levels, from all waveforms: matrix (number + 1, number + 1), and right-hand side. An echo that is wider than the
   reference, or narrower, changes all of their variances by the same. Samples far out count less, by Student's law.
   Echoes were fitted with the present pulse, and hide most of its errors: `counted` is the weight of what their amplitudes and
   times may absorb. With all of it pulses of two samples were still a hundredth off after ten rounds. Widths hide errors too, but
   without them the pulse's own is hardly known: halves of a canopy differed by a fifth. */
EXPORT int64_t learn_pulse(const Described *w, int64_t number, const double *delay, const double *variance, double reference,
                           int64_t most, double counted, double *matrix, double *right) {
    Desk d = {0};
    const int64_t vectors = VECTORS(w->length), rows = number + 2;
    int good = furnish(&d, rows + 2 * most + 1, vectors);
    int64_t *low = (int64_t *)d.matrix, *high = low + rows; /* vectors that a row reaches: 0 elsewhere */
    lanes *moves = d.rows + rows * vectors;
    memset(matrix, 0, (number + 1) * (number + 1) * sizeof(double));
    memset(right, 0, (number + 1) * sizeof(double));
    for (int64_t i = 0; i < w->n && good; i++) {
        const int64_t first = w->first[i], end = w->first[i + 1], begin = i * w->length;
        if (end == first || end - first > most) continue;
        lay_out(w, i, &d);
        float *weight = (float *)d.weight, *y = (float *)(d.rows + (number + 1) * vectors);
        for (int64_t t = 0; t < vectors * LANES; t++) {
            int counts = t < w->length && w->used[begin + t];
            double model = counts ? w->model[begin + t] : 0, rest = counts ? w->left[begin + t] : 0;
            double spread = w->variance + w->gain * at_least(model, 0) + w->change * w->change * model * model;
            weight[t] = counts ? sqrt((FREEDOM + 1) / (FREEDOM + rest * rest / spread) / spread) : 0;
            y[t] = counts ? rest + model : 0;
        }
        for (int64_t c = 0; c < number; c++) {
            lanes *row = d.rows + c * vectors;
            memset(row, 0, vectors * sizeof(lanes));
            low[c] = vectors; high[c] = 0;
            for (int64_t j = first; j < end; j++) {
                double wide = w->width[j], more = wide * wide - reference * reference;
                double sigma = sqrt(at_least(variance[c] + more, NARROWEST * variance[c]));
                double place = w->time[j] + delay[c];
                float whole = rint(place), part = place - rint(place), inverse = 1 / sigma, height = w->amplitude[j] * wide / sigma;
                int64_t from = at_most(at_least(place - REACH * sigma, 0), w->length) / LANES;
                int64_t to = VECTORS((int64_t)at_most(at_least(place + REACH * sigma + 1, 0), w->length));
                low[c] = from < low[c] ? from : low[c]; high[c] = to > high[c] ? to : high[c];
                for (int64_t v = from; v < to; v++) {
                    lanes z = distance(d.x[v], whole, part, inverse);
                    row[v] += exp_lanes(z * z * -0.5f) * height;
                }
            }
        }
        for (int64_t v = 0; v < vectors; v++) d.rows[number * vectors + v] = ALL(1);
        for (int64_t r = counted < 1 ? 0 : number; r < rows; r++) { low[r] = 0; high[r] = vectors; }
        if (counted < 1) find_moves(w, &d, first, end, moves);
        for (int64_t r = 0; r < rows; r++) {
            lanes *row = d.rows + r * vectors;
            for (int64_t v = low[r]; v < high[r]; v++) row[v] *= d.weight[v];
            for (int64_t b = 0; b < 2 * (end - first) && counted < 1; b++) {
                const lanes *move = moves + b * vectors;
                const float share = (1 - counted) * multiply(vectors, row, move);
                for (int64_t v = 0; v < vectors; v++) row[v] -= move[v] * share;
            }
            for (int64_t c = 0, some; c <= r && c <= number; c += some) {
                /* Four at a time: to wait for each addition of a sum takes longer than to make it. */
                lanes sum[4] = {{0}};
                int64_t from = vectors, to = 0;
                for (some = 0; some < 4 && c + some <= r && c + some <= number; some++) {
                    from = low[c + some] < from ? low[c + some] : from;
                    to = high[c + some] > to ? high[c + some] : to;
                }
                from = low[r] > from ? low[r] : from; to = high[r] < to ? high[r] : to;
                for (int64_t v = from; v < to; v++)
                    for (int64_t q = 0; q < 4; q++) sum[q] += row[v] * d.rows[(c + q) * vectors + v];
                const lanes product = sum_four(sum[0], sum[1], sum[2], sum[3]);
                for (int64_t q = 0; q < some; q++) *(r <= number ? matrix + r * (number + 1) + c + q : right + c + q) += product[q];
            }
        }
    }
    for (int64_t r = 0; r <= number; r++)
        for (int64_t c = r + 1; c <= number; c++) matrix[r * (number + 1) + c] = matrix[c * (number + 1) + r];
    clear_desk(&d);
    return good ? 0 : -1;
}

/* The sum of the echoes of each waveform, (n, length). */
EXPORT int64_t render_pulses(const Described *w, float *out) {
    Desk d = {0};
    const int64_t vectors = VECTORS(w->length);
    int good = furnish(&d, 3, vectors);
    for (int64_t t = 0; t < vectors * LANES && good; t++) ((float *)d.x)[t] = t;
    for (int64_t i = 0; i < w->n && good; i++) {
        for (int64_t v = 0; v < vectors; v++) d.rest[v] = ALL(0);
        for (int64_t j = w->first[i]; j < w->first[i + 1]; j++) {
            double before, after;
            find_reach(&w->pulse, w->width[j], &before, &after);
            const int64_t from = at_most(at_least(w->time[j] - before, 0), w->length) / LANES;
            const int64_t count = VECTORS((int64_t)at_most(at_least(w->time[j] + after + 1, 0), w->length)) - from;
            if (count > 0) draw_echo(w, j, d.x + from, count, d.rows);
            for (int64_t v = 0; v < count; v++) d.rest[from + v] += d.rows[v] * (float)w->amplitude[j];
        }
        memcpy(out + i * w->length, d.rest, w->length * sizeof(float));
    }
    clear_desk(&d);
    return good ? 0 : -1;
}

typedef uint8_t bytes __attribute__((vector_size(LANES)));

enum { PAIR_KINDS = 4, PAIRS_TOGETHER = 256 }; /* vectors whose squares are added in single precision: 1e-6 of their sum */
enum { HIGH = 1, LOW = 2 };

typedef struct { lane_bits number[PAIR_KINDS]; lanes square[PAIR_KINDS]; } PairSums;

INLINE void add_kind(lane_bits is, lanes square, int64_t kind, PairSums *sums) {
    sums->number[kind] -= is;
    sums->square[kind] += (lanes)(is & (lane_bits)square);
}

/* The next `count` pairs, at most LANES. */
INLINE void add_pairs(const float *a, const uint8_t *marks, int64_t ahead, size_t count, PairSums *sums) {
    lanes first = ALL(NAN), second = ALL(NAN);
    memcpy(&first, a, count * sizeof(float));
    memcpy(&second, a + ahead, count * sizeof(float));
    const lanes step = second - first, square = step * step;
    const lane_bits quiet = step == step;      /* a sample that is not quiet is no number */
    add_kind(quiet, square, 0, sums);
    if (!marks) return;
    bytes one = {0}, other = {0};
    memcpy(&one, marks, count);
    memcpy(&other, marks + ahead, count);
    const lane_bits both = __builtin_convertvector(one | other, lane_bits);
    const lane_bits is_high = quiet & ((both & HIGH) != 0), is_low = quiet & ((both & LOW) != 0);
    add_kind(is_high, square, 1, sums);
    add_kind(is_low, square, 2, sums);
    add_kind(is_high & is_low, square, 3, sums);
}

INLINE void add_all_pairs(int64_t end, const float *signal, const uint8_t *marks, int64_t ahead, double *out) {
    for (int64_t i = 0; i < end;) {
        PairSums sums = {0};
        int64_t most = i + PAIRS_TOGETHER * LANES, last = most < end ? most : end;
        for (; i + LANES <= last; i += LANES) add_pairs(signal + i, marks ? marks + i : NULL, ahead, LANES, &sums);
        if (i < last) add_pairs(signal + i, marks ? marks + i : NULL, ahead, last - i, &sums);
        i = last;
        for (int64_t k = 0; k < (marks ? PAIR_KINDS : 1); k++)
            for (int64_t lane = 0; lane < LANES; lane++) {
                out[2 * k] += sums.number[k][lane];
                out[2 * k + 1] += sums.square[k][lane];
            }
    }
}

/* Pairs of quiet samples `lag` to `last` apart of waveforms in columns, signal (s, n), no number where it is not quiet:
   number and sum of squared differences of all pairs, of those with a sample of mark HIGH, of LOW, and of both: out
   (last - lag + 1, 4, 2), zeros. Without marks (s, n) only the first. */
INLINE int64_t pair_differences_any(int64_t s, int64_t n, const float *signal, const uint8_t *marks, int64_t lag, int64_t last, double *out) {
    for (; lag <= last; lag++, out += 2 * PAIR_KINDS) {
        const int64_t ahead = lag * n, end = (s - lag) * n;
        if (marks) add_all_pairs(end, signal, marks, ahead, out);
        else add_all_pairs(end, signal, NULL, ahead, out);
    }
    return 0;
}
OFFER(pair_differences, (int64_t s, int64_t n, const float *signal, const uint8_t *marks, int64_t lag, int64_t last, double *out),
      (s, n, signal, marks, lag, last, out))
