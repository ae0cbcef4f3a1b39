/* Planes through sets of points, and which sets lie on one line, or on two parallel ones. kernels/geometry/planes.py has
   the reasons. A survey asks for a thousand sets at each of twenty radii, so that products of points must not be arrays. */

enum { SUMS = 10 };                            /* number of points, sums of x, y, z and of their products */
static const int PRODUCTS[6][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}};

static void add_point(const double *point, double *sums) {
    sums[0] += 1;
    for (int i = 0; i < 3; i++) sums[1 + i] += point[i];
    for (int i = 0; i < 6; i++) sums[4 + i] += point[PRODUCTS[i][0]] * point[PRODUCTS[i][1]];
}

/* Centre and covariance of the points that were added up. */
static void describe_sums(const double *sums, double *centre, double *covariance) {
    const double number = sums[0] > 1 ? sums[0] : 1;
    for (int i = 0; i < 3; i++) centre[i] = sums[1 + i] / number;
    for (int i = 0; i < 6; i++) {
        const int a = PRODUCTS[i][0], b = PRODUCTS[i][1];
        covariance[3 * a + b] = covariance[3 * b + a] = sums[4 + i] / number - centre[a] * centre[b];
    }
}

/* The value of this rank, from 0, of n values, whose order is lost (Hoare 1961). */
static double take_ranked(int64_t n, double *values, int64_t rank) {
    for (int64_t low = 0, high = n - 1; low < high;) {
        const double pivot = values[rank];
        int64_t i = low, j = high;
        do {
            while (values[i] < pivot) i++;
            while (pivot < values[j]) j--;
            if (i <= j) {
                const double other = values[i];
                values[i++] = values[j];
                values[j--] = other;
            }
        } while (i <= j);
        if (j < rank) low = i;
        if (rank < i) high = j;
    }
    return values[rank];
}

enum { SETTLED, TIGHT, MOVED, NEW };           /* states of a set: the last two need a plane of their points that count */

/* One round of fit_planes: which points of n sets count, by their distance from planes with these axes, and centre and
   covariance of those of sets that are MOVED or NEW. Those of set i are points start[i] .. start[i + 1] - 1, (k, 3). `tight`
   is the factor on their median distance in sets that are not `smooth`, or 0; `outlying` that in all others. */
EXPORT int64_t trim_planes(int64_t n, const int64_t *start, const double *points, double smooth, double tight, double outlying, double least_spread,
                           const double *axes, const double *spreads, double *whole, uint8_t *counts, double *limit, double *centre,
                           double *covariance, uint8_t *state) {
    int64_t most = 1;
    for (int64_t i = 0; i < n; i++) most = start[i + 1] - start[i] > most ? start[i + 1] - start[i] : most;
    double *off = malloc(2 * most * sizeof *off);
    for (int64_t i = 0; i < n && off; i++, axes += 9, spreads += 3, whole += SUMS, centre += 3, covariance += 9) {
        const double *own = points + 3 * start[i];
        const int64_t count = start[i + 1] - start[i];
        uint8_t *is_kept = counts + start[i];
        if (state[i] == SETTLED) continue;
        if (state[i] == NEW) {
            for (int64_t j = 0; j < count; j++) add_point(own + 3 * j, whole);
            describe_sums(whole, centre, covariance);
            state[i] = MOVED;
            continue;
        }
        if (!count) { state[i] = SETTLED; continue; }
        double rest[SUMS] = {0}, *ranked = off + most;
        for (int64_t j = 0; j < count; j++) {
            const double *p = own + 3 * j;
            ranked[j] = off[j] = fabs((p[0] - centre[0]) * axes[0] + (p[1] - centre[1]) * axes[3] + (p[2] - centre[2]) * axes[6]);
        }
        /* The median distance from a plane fitted to few points is too small (Rousseeuw and Leroy 1987). */
        const double few = 1 + 5.0 / (count > 4 ? count - 3 : 1);
        const int is_tight = tight > 0 && spreads[0] > smooth * spreads[1];
        limit[i] = (is_tight ? tight : outlying * few) * at_least(take_ranked(count, ranked, count / 2), least_spread);
        state[i] = is_tight ? TIGHT : SETTLED;
        for (int64_t j = 0; j < count; j++) {
            const int near = off[j] <= limit[i];
            if (near != is_kept[j]) state[i] = MOVED;
            is_kept[j] = near;
            if (!near) add_point(own + 3 * j, rest);
        }
        if (state[i] != MOVED) continue;
        for (int q = 0; q < SUMS; q++) rest[q] = whole[q] - rest[q];
        describe_sums(rest, centre, covariance);
    }
    const int good = !!off;
    free(off);
    return good ? 0 : -1;
}

enum { MOMENTS = 12 };                         /* of orders 2 to 4 */
static const int POWERS[MOMENTS][2] = {
    {2, 0}, {1, 1}, {0, 2}, {3, 0}, {2, 1}, {1, 2}, {0, 3}, {4, 0}, {3, 1}, {2, 2}, {1, 3}, {0, 4},
};

/* Kurtosis less squared skewness less 1 of coordinates across the direction (a, b): 0 for two values, NaN for one. */
static double variety(const double *m, double a, double b) {
    const double second = a * a * m[0] + 2 * a * b * m[1] + b * b * m[2];
    const double third = a * a * a * m[3] + b * b * b * m[6] + 3 * a * b * (a * m[4] + b * m[5]);
    const double fourth = a * a * a * a * m[7] + b * b * b * b * m[11] + 6 * a * a * b * b * m[9] + 4 * a * b * (a * a * m[8] + b * b * m[10]);
    return fourth / (second * second) - third * third / (second * second * second) - 1;
}

/* k points in n sets; d directions (d, 2). In line: the least variety or breadth is below the given one. */
EXPORT int64_t find_two_lines(int64_t n, int64_t k, const double *u, const double *v, const int64_t *set, int64_t d,
                              const double *directions, double least_variety, double least_breadth, uint8_t *in_line) {
    const int64_t size = MOMENTS + 3;
    double *sums = calloc(n * size + 1, sizeof *sums);
    if (!sums) return -1;
    for (int64_t i = 0; i < k; i++) {
        double *own = sums + set[i] * size;
        own[0] += 1;
        own[1] += u[i];
        own[2] += v[i];
    }
    for (int64_t i = 0; i < k; i++) {
        double *own = sums + set[i] * size;
        const double x = u[i] - own[1] / own[0], y = v[i] - own[2] / own[0], xx = x * x, yy = y * y;
        const double px[5] = {1, x, xx, x * xx, xx * xx}, py[5] = {1, y, yy, y * yy, yy * yy};
        for (int j = 0; j < MOMENTS; j++) own[3 + j] += px[POWERS[j][0]] * py[POWERS[j][1]];
    }
    for (int64_t i = 0; i < n; i++) {
        double *own = sums + i * size, *m = own + 3, least = INFINITY;
        for (int j = 0; j < MOMENTS; j++) m[j] /= own[0] > 1 ? own[0] : 1;
        for (int64_t j = 0; j < d; j++) least = fmin(least, variety(m, directions[2 * j], directions[2 * j + 1]));
        const double middle = 0.5 * (m[0] + m[2]), half = 0.5 * (m[0] - m[2]), longer = sqrt(half * half + m[1] * m[1]);
        in_line[i] = least < least_variety || middle - longer < least_breadth * (middle + longer);
    }
    free(sums);
    return 0;
}
