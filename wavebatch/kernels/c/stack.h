/* A sum of Gaussians: fitted to a stacked pulse, for kernels/fit/learn_pulse.py, and its peak and width by width.

   Levenberg and Marquardt's steps, cut off at the bounds, as Python's `fit_bounded`, which the twin in the tests calls. */
typedef struct {
    int64_t n, m;                              /* lags, components */
    const double *lag, *value, *weight;
    double low[3], high[3];                    /* bounds of weight, place and sigma of a component */
    double early, onset, last, end;            /* no centre before `early` or two sigmas less `onset`, but before `last`; end of the stack */
    double damping, most_damping, settled;
    int64_t most;                              /* evaluations */
} Stacked;

static double earliest(const Stacked *s, double sigma) { return fmin(fmax(s->early, 2 * sigma - s->onset), s->last); }

/* Draws components, whose place is a share of the way from the earliest to the end: z and bell (m, n), rest (n); returns its squares. */
static double draw_stacked(const Stacked *s, const double *p, double *z, double *restrict bell, double *restrict rest) {
    for (int64_t c = 0; c < s->m; c++) {
        const double sigma = p[3 * c + 2], first = earliest(s, sigma), delay = first + p[3 * c + 1] * (s->end - first);
        for (int64_t i = c * s->n; i < (c + 1) * s->n; i++) {
            z[i] = (s->lag[i - c * s->n] - delay) / sigma;
            bell[i] = -0.5 * z[i] * z[i];
        }
    }
    exponentials(s->m * s->n, bell, bell);
    double cost = 0;
    memset(rest, 0, s->n * sizeof(double));
    for (int64_t c = 0; c < s->m; c++)
        for (int64_t i = 0; i < s->n; i++) rest[i] += p[3 * c] * bell[c * s->n + i];
    for (int64_t i = 0; i < s->n; i++) rest[i] = (rest[i] - s->value[i]) * s->weight[i];
    for (int64_t i = 0; i < s->n; i++) cost += rest[i] * rest[i];
    return cost;
}

/* Normal equations (3 m, 3 m), below the diagonal, and the way downhill (3 m). Every sum goes through the lags in order; two
   rows of the matrix by eight columns are in registers meanwhile. rows: (n, stride), room for 3 m columns and the rest. */
INLINE void gather_stacked(const Stacked *s, const double *p, const double *z, const double *bell, const double *rest,
                           int64_t stride, double *rows, double *normal, double *downhill) {
    const int64_t size = 3 * s->m;
    for (int64_t c = 0; c < s->m; c++) {
        const double *own = p + 3 * c, first = earliest(s, own[2]);
        const double moves = first > s->early && first < s->last ? 2 * (1 - own[1]) : 0;
        for (int64_t i = 0; i < s->n; i++) {
            double *row = rows + i * stride + 3 * c, at = z[c * s->n + i];
            const double height = bell[c * s->n + i] * s->weight[i], by_delay = own[0] * height * at / own[2];
            row[0] = height;
            row[1] = by_delay * (s->end - first);
            row[2] = by_delay * (at + moves);
        }
    }
    for (int64_t i = 0; i < s->n; i++) rows[i * stride + size] = -rest[i];
    for (int64_t a = 0; a <= size; a += 4)
        for (int64_t b = 0; b < size && b <= a + 3; b += 2 * LANES) {
            wide sum[8] = {{0}};
            for (const double *row = rows; row < rows + s->n * stride; row += stride) {
                const wide low = *(const wide *)(row + b), high = *(const wide *)(row + b + LANES);
                sum[0] += row[a] * low; sum[1] += row[a] * high;
                sum[2] += row[a + 1] * low; sum[3] += row[a + 1] * high;
                sum[4] += row[a + 2] * low; sum[5] += row[a + 2] * high;
                sum[6] += row[a + 3] * low; sum[7] += row[a + 3] * high;
            }
            for (int64_t q = 0; q < 8 * LANES; q++) {
                const int64_t i = a + q / (2 * LANES), j = b + q % (2 * LANES);
                if (i == size && j < size) downhill[j] = sum[q / LANES][q % LANES];
                if (i < size && j <= i) normal[i * size + j] = sum[q / LANES][q % LANES];
            }
        }
}

/* Where a damped step leads; an unknown at its bound that would leave it is held. */
static void step_stacked(const Stacked *s, double damping, const double *normal, const double *downhill, const double *at,
                         double *matrix, double *pivot, double *there) {
    const int64_t size = 3 * s->m;
    double largest = 1e-300;
    memcpy(matrix, normal, size * size * sizeof(double));
    for (int64_t a = 0; a < size; a++) {
        const int held = (at[a] <= s->low[a % 3] && downhill[a] < 0) || (at[a] >= s->high[a % 3] && downhill[a] > 0);
        there[a] = held ? 0 : downhill[a];
        for (int64_t b = 0; held && b < size; b++) matrix[a > b ? a * size + b : b * size + a] = 0;
        largest = fmax(largest, matrix[a * size + a]);
    }
    for (int64_t a = 0; a < size; a++) {
        double *own = matrix + a * size + a;
        if (*own > 0 || there[a] != 0) *own += damping * fmax(*own, 1e-12 * largest);
    }
    factor(size, matrix, pivot, 0);
    solve(size, matrix, there);
    for (int64_t a = 0; a < size; a++) there[a] = fmin(fmax(at[a] + there[a], s->low[a % 3]), s->high[a % 3]);
}

/* Fits each of some starts, (starts, 3 m): weight, delay and sigma of each component, in place. Returns the one that misses
   the lags least, whatever their weights. */
INLINE int64_t fit_stack_any(const Stacked *s, int64_t starts, double *found) {
    const int64_t size = 3 * s->m, rows = s->m * s->n, stride = size + 4 * LANES;
    double *memory = calloc(2 * rows + s->n * (1 + stride) + 2 * size * size + 3 * size + 1, sizeof(double)), least = INFINITY;
    if (!memory) return -1;
    double *z = memory, *bell = z + rows, *rest = bell + rows, *normal = rest + s->n, *matrix = normal + size * size;
    double *downhill = matrix + size * size, *pivot = downhill + size, *there = pivot + size, *table = there + size;
    int64_t best = 0;
    for (int64_t start = 0; start < starts; start++) {
        double *at = found + start * size, missed = 0;
        for (int64_t a = 1; a < size; a += 3) at[a] = (at[a] - earliest(s, at[a + 1])) / (s->end - earliest(s, at[a + 1]));
        for (int64_t a = 0; a < size; a++) at[a] = fmin(fmax(at[a], s->low[a % 3]), s->high[a % 3]);
        double cost = draw_stacked(s, at, z, bell, rest), damping = s->damping;
        gather_stacked(s, at, z, bell, rest, stride, table, normal, downhill);
        for (int64_t i = 1; i < s->most; i++) {
            step_stacked(s, damping, normal, downhill, at, matrix, pivot, there);
            const double lower = draw_stacked(s, there, z, bell, rest);
            if (lower < cost) {
                const int small = cost - lower < s->settled * cost;
                memcpy(at, there, size * sizeof(double));
                cost = lower;
                damping = fmax(damping / 5, 1e-9);
                if (small) break;
                gather_stacked(s, at, z, bell, rest, stride, table, normal, downhill);
            } else if (damping > s->most_damping) {
                break;
            } else {
                damping *= 4;
            }
        }
        if (starts > 1) draw_stacked(s, at, z, bell, rest);
        for (int64_t i = 0; i < s->n; i++) missed += rest[i] / s->weight[i] * (rest[i] / s->weight[i]);
        if (missed < least) { least = missed; best = start; }
        for (int64_t c = 1; c < size; c += 3) at[c] = earliest(s, at[c + 1]) + at[c] * (s->end - earliest(s, at[c + 1]));
    }
    free(memory);
    return best;
}
OFFER(fit_stack, (const Stacked *s, int64_t starts, double *found), (s, starts, found))

/* The main lobe of pulses is looked for within LOBE widths of the main component, in COARSE steps per width; HALVINGS
   steps then find its peak and edges, to 1e-7 of such a step. */
static const double LOBE = 6, COARSE = 8;
enum { HALVINGS = 40, PLACES = 97 };

INLINE wide pick_wide(wide_bits on, wide yes, wide no) { return (wide)((on & (wide_bits)yes) | (~on & (wide_bits)no)); }

/* Sums of a Gaussian of height 1 and k others, each with its delay, for four widths. */
INLINE wide draw_lobes(int64_t k, const wide *inverse, const wide *height, const double *terms, wide at) {
    wide z = at * inverse[0], pulse = exp_wide(z * z * -0.5);
    for (int64_t i = 0; i < k; i++) {
        z = (at - terms[3 * i + 1]) * inverse[i + 1];
        pulse += exp_wide(z * z * -0.5) * height[i + 1];
    }
    return pulse;
}

/* Peak and full width at half maximum of the main lobe, for n widths, a multiple of four, of the main component; k others
   have weight, delay and variance. */
INLINE int64_t measure_lobes_any(int64_t n, const double *width, int64_t k, const double *terms, double *peak, double *half_width) {
    wide *inverse = malloc(2 * (k + 1) * sizeof(wide)), *height = inverse + k + 1, coarse[PLACES];
    if (!inverse) return -1;
    for (int64_t i = 0; i < n; i += LANES) {
        const wide main = *(const wide *)(width + i), step = main / COARSE;
        inverse[0] = 1 / main;
        for (int64_t j = 0; j < k; j++) {
            const wide variance = main * main + terms[3 * j + 2];
            for (int lane = 0; lane < LANES; lane++) inverse[j + 1][lane] = 1 / sqrt(variance[lane]);
            height[j + 1] = terms[3 * j] * (main * inverse[j + 1]);
        }
        wide top = {0}, best = {0}, right = {0}, left = {0};
        for (int64_t j = 0; j < PLACES; j++) {
            coarse[j] = draw_lobes(k, inverse, height, terms, main * (j / COARSE - LOBE));
            const wide_bits higher = j ? coarse[j] > best : ~(wide_bits){0};
            best = pick_wide(higher, coarse[j], best), top = pick_wide(higher, (wide){0} + (double)j, top);
        }
        const wide middle = main * (top / COARSE - LOBE);
        wide low = middle - step, high = middle + step;
        for (int j = 0; j < HALVINGS; j++) { /* the thirds of an interval that holds the peak: the lower one goes */
            const wide third = (high - low) / 3, after = low + third, before = high - third;
            const wide_bits rises = draw_lobes(k, inverse, height, terms, after) < draw_lobes(k, inverse, height, terms, before);
            low = pick_wide(rises, after, low), high = pick_wide(rises, high, before);
        }
        const wide whole = draw_lobes(k, inverse, height, terms, 0.5 * (low + high)), half = 0.5 * whole;
        right += (double)(PLACES - 1);
        for (int64_t j = 0; j < PLACES; j++) {
            const wide place = (wide){0} + (double)j;
            const wide_bits below = coarse[j] < half;
            left = pick_wide(below & (place < top), place, left);
            right = pick_wide(below & (place > top) & (place < right), place, right);
        }
        wide edges[2];
        for (int side = 0; side < 2; side++) {
            wide outside = side ? left : right, inside = side ? left + 1 : right - 1;
            outside = main * (outside / COARSE - LOBE), inside = main * (inside / COARSE - LOBE);
            for (int j = 0; j < HALVINGS; j++) {
                const wide at = 0.5 * (inside + outside);
                const wide_bits is_in = draw_lobes(k, inverse, height, terms, at) >= half;
                inside = pick_wide(is_in, at, inside), outside = pick_wide(is_in, outside, at);
            }
            edges[side] = 0.5 * (inside + outside);
        }
        *(wide *)(peak + i) = whole, *(wide *)(half_width + i) = edges[0] - edges[1];
    }
    free(inverse);
    return 0;
}
OFFER(measure_lobes, (int64_t n, const double *width, int64_t k, const double *terms, double *peak, double *half_width),
      (n, width, k, terms, peak, half_width))
