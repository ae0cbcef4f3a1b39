/* A sum of Gaussians fitted to a stacked pulse: kernels/fit/learn_pulse.py says what it is for.

   Levenberg and Marquardt's steps, cut off at the bounds, as Python's `fit_bounded`, which the twin in the tests calls. */
typedef struct {
    int64_t n, m;                              /* lags, components */
    const double *lag, *value, *weight;
    const double *low, *high;                  /* bounds of weight, place and sigma of each component */
    double early, onset, last, end;            /* no centre before `early` or two sigmas less `onset`, but before `last`; end of the stack */
    double damping, most_damping, settled;
    int64_t most;                              /* evaluations */
} Stacked;

static double earliest(const Stacked *s, double sigma) { return fmin(fmax(s->early, 2 * sigma - s->onset), s->last); }

/* Draws components, whose place is a share of the way from the earliest to the end: z and bell (m, n), rest (n); returns its squares. */
static double draw_stacked(const Stacked *s, const double *p, double *z, double *bell, double *rest) {
    for (int64_t c = 0; c < s->m; c++) {
        const double sigma = p[3 * c + 2], first = earliest(s, sigma), delay = first + p[3 * c + 1] * (s->end - first);
        for (int64_t i = c * s->n; i < (c + 1) * s->n; i++) {
            z[i] = (s->lag[i - c * s->n] - delay) / sigma;
            bell[i] = -0.5 * z[i] * z[i];
        }
    }
    exponentials(s->m * s->n, bell, bell);
    double cost = 0;
    for (int64_t i = 0; i < s->n; i++) {
        double sum = 0;
        for (int64_t c = 0; c < s->m; c++) sum += p[3 * c] * bell[c * s->n + i];
        rest[i] = (sum - s->value[i]) * s->weight[i];
        cost += rest[i] * rest[i];
    }
    return cost;
}

/* Normal equations (3 m, 3 m), below the diagonal, and the way downhill (3 m). */
static void gather_stacked(const Stacked *s, const double *p, const double *z, const double *bell, const double *rest,
                           double *row, double *normal, double *downhill) {
    const int64_t size = 3 * s->m;
    memset(normal, 0, size * size * sizeof(double));
    memset(downhill, 0, size * sizeof(double));
    for (int64_t i = 0; i < s->n; i++) {
        for (int64_t c = 0; c < s->m; c++) {
            const double *own = p + 3 * c, first = earliest(s, own[2]), at = z[c * s->n + i];
            const double height = bell[c * s->n + i] * s->weight[i], by_delay = own[0] * height * at / own[2];
            const int moves = first > s->early && first < s->last;
            row[3 * c] = height;
            row[3 * c + 1] = by_delay * (s->end - first);
            row[3 * c + 2] = by_delay * (at + (moves ? 2 * (1 - own[1]) : 0));
        }
        for (int64_t a = 0; a < size; a++) {
            downhill[a] -= row[a] * rest[i];
            for (int64_t b = 0; b <= a; b++) normal[a * size + b] += row[a] * row[b];
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
        const int held = (at[a] <= s->low[a] && downhill[a] < 0) || (at[a] >= s->high[a] && downhill[a] > 0);
        there[a] = held ? 0 : downhill[a];
        for (int64_t b = 0; held && b < size; b++) matrix[a > b ? a * size + b : b * size + a] = 0;
        largest = fmax(largest, matrix[a * size + a]);
    }
    for (int64_t a = 0; a < size; a++) {
        double *own = matrix + a * size + a;
        if (*own > 0 || there[a] != 0) *own += damping * fmax(*own, 1e-12 * largest);
    }
    factor(size, matrix, pivot, 0);
    solve(size, matrix, pivot, there);
    for (int64_t a = 0; a < size; a++) there[a] = fmin(fmax(at[a] + there[a], s->low[a]), s->high[a]);
}

/* Fits in place; at (3 m). */
EXPORT int64_t fit_stack(const Stacked *s, double *at) {
    const int64_t size = 3 * s->m, rows = s->m * s->n;
    double *memory = malloc((2 * rows + s->n + 2 * size * size + 4 * size + 1) * sizeof(double));
    if (!memory) return -1;
    double *z = memory, *bell = z + rows, *rest = bell + rows, *normal = rest + s->n, *matrix = normal + size * size;
    double *downhill = matrix + size * size, *row = downhill + size, *pivot = row + size, *there = pivot + size;
    double cost = draw_stacked(s, at, z, bell, rest), damping = s->damping;
    gather_stacked(s, at, z, bell, rest, row, normal, downhill);
    for (int64_t i = 1; i < s->most; i++) {
        step_stacked(s, damping, normal, downhill, at, matrix, pivot, there);
        const double found = draw_stacked(s, there, z, bell, rest);
        if (found < cost) {
            const int small = cost - found < s->settled * cost;
            memcpy(at, there, size * sizeof(double));
            cost = found;
            damping = fmax(damping / 5, 1e-9);
            if (small) break;
            gather_stacked(s, at, z, bell, rest, row, normal, downhill);
        } else if (damping > s->most_damping) {
            break;
        } else {
            damping *= 4;
        }
    }
    free(memory);
    return 0;
}
