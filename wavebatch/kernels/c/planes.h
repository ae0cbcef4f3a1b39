/* Sets of points in a plane: which lie on one line, or on two parallel ones. kernels/geometry/planes.py has the reasons.

   A survey asks for a thousand sets at each of twenty radii, so that the products of all points must not be arrays. */

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
