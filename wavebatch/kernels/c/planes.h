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

/* Eigenvalues of a symmetric matrix, ascending, and unit eigenvectors as columns (Jacobi 1846). Last bits and signs of those of
   LAPACK depend on the processor. */
static void find_axes(const double *matrix, double *spreads, double *axes) {
    double a[9], vectors[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    memcpy(a, matrix, sizeof a);
    for (int sweep = 0; sweep < 12; sweep++) { /* six are enough where it converges as it must */
        if (fabs(a[1]) + fabs(a[2]) + fabs(a[5]) <= 1e-30 * (fabs(a[0]) + fabs(a[4]) + fabs(a[8]))) break;
        for (int r = 2; r >= 0; r--) {         /* turns the other two axes until they have no covariance */
            const int p = r == 0, q = r == 2 ? 1 : 2, pq = 3 * p + q, low = r < p ? 3 * r + p : 3 * p + r, high = r < q ? 3 * r + q : 3 * q + r;
            if (a[pq] == 0) continue;
            const double ratio = (a[4 * q] - a[4 * p]) / (2 * a[pq]), tangent = (ratio < 0 ? -1 : 1) / (fabs(ratio) + sqrt(ratio * ratio + 1));
            const double cosine = 1 / sqrt(tangent * tangent + 1), sine = tangent * cosine, other = a[low];
            a[4 * p] -= tangent * a[pq];
            a[4 * q] += tangent * a[pq];
            a[pq] = 0;
            a[low] = cosine * other - sine * a[high];
            a[high] = sine * other + cosine * a[high];
            for (int i = 0; i < 9; i += 3) {
                const double one = vectors[i + p];
                vectors[i + p] = cosine * one - sine * vectors[i + q];
                vectors[i + q] = sine * one + cosine * vectors[i + q];
            }
        }
    }
    for (int i = 0; i < 3; i++) {
        int rank = 0;
        for (int j = 0; j < 3; j++) rank += a[4 * j] < a[4 * i] || (a[4 * j] == a[4 * i] && j < i);
        spreads[rank] = a[4 * i];
        for (int j = 0; j < 3; j++) axes[3 * j + rank] = vectors[3 * j + i];
    }
}

/* Planes through n sets without outliers; the points of set i are start[i] .. start[i + 1] - 1, (k, 3). `tight` is the factor on
   the median distance in the first rounds of sets that are not `smooth`, `outlying` that in all others. */
EXPORT int64_t trim_planes(int64_t n, const int64_t *start, const double *points, double smooth, double tight, double outlying, double least_spread,
                           int64_t tight_rounds, int64_t rounds, double *axes, double *spreads, double *centre, int64_t *kept, double *limit) {
    int64_t most = 1;
    for (int64_t i = 0; i < n; i++) most = start[i + 1] - start[i] > most ? start[i + 1] - start[i] : most;
    double *off = malloc(3 * most * sizeof *off), *ranked = off + most, covariance[9];
    uint8_t *counts = (uint8_t *)(ranked + most);
    for (int64_t i = 0; i < n && off; i++, axes += 9, spreads += 3, centre += 3) {
        const double *own = points + 3 * start[i];
        const int64_t count = start[i + 1] - start[i];
        double whole[SUMS] = {0};
        for (int64_t j = 0; j < count; j++) add_point(own + 3 * j, whole);
        describe_sums(whole, centre, covariance);
        find_axes(covariance, spreads, axes);
        memset(counts, 1, count);
        kept[i] = count;
        limit[i] = INFINITY;
        for (int64_t round = 1; round <= rounds && count; round++) {
            for (int64_t j = 0; j < count; j++) {
                const double *p = own + 3 * j;
                ranked[j] = off[j] = fabs((p[0] - centre[0]) * axes[0] + (p[1] - centre[1]) * axes[3] + (p[2] - centre[2]) * axes[6]);
            }
            /* The median distance from a plane fitted to few points is too small (Rousseeuw and Leroy 1987). */
            const double few = 1 + 5.0 / (count > 4 ? count - 3 : 1);
            const int is_tight = round <= tight_rounds && spreads[0] > smooth * spreads[1];
            limit[i] = (is_tight ? tight : outlying * few) * at_least(take_ranked(count, ranked, count / 2), least_spread);
            double rest[SUMS] = {0};
            int has_moved = 0;
            for (int64_t j = 0; j < count; j++) {
                const int near = off[j] <= limit[i];
                has_moved |= near != counts[j];
                counts[j] = near;
                if (!near) add_point(own + 3 * j, rest);
            }
            if (has_moved) {
                for (int q = 0; q < SUMS; q++) rest[q] = whole[q] - rest[q];
                kept[i] = (int64_t)rest[0];
                describe_sums(rest, centre, covariance);
                find_axes(covariance, spreads, axes);
            } else if (!is_tight) break;
        }
    }
    const int good = !!off;
    free(off);
    return good ? 0 : -1;
}

enum { CUTS = 6, HALF_SUMS = 10 };             /* number, and sums of u, v, r, uu, uv, vv, ur, vr and rr of places in a plane */

/* What a plane r = a + b u + c v explains of the squares of r; -INFINITY where there is none. */
static double explain_heights(const double *s, int64_t least, double singular, double *slopes) {
    const double uu = s[4] - s[1] * s[1] / s[0], uv = s[5] - s[1] * s[2] / s[0], vv = s[6] - s[2] * s[2] / s[0];
    const double ur = s[7] - s[1] * s[3] / s[0], vr = s[8] - s[2] * s[3] / s[0], size = uu * vv - uv * uv;
    slopes[0] = (ur * vv - vr * uv) / size;
    slopes[1] = (vr * uu - ur * uv) / size;
    if (!(s[0] >= least && size > singular * (uu + vv) * (uu + vv))) return -INFINITY;
    return s[3] * s[3] / s[0] + slopes[0] * ur + slopes[1] * vr;
}

/* For each set what its plane explains of the heights above it, and what those of two halves do at the best of CUTS cuts, whose
   directions are (CUTS, 2): number of points, sum of squares, both figures; then the slopes of the halves. */
EXPORT int64_t compare_halves(int64_t n, const int64_t *start, const double *points, const double *axes, const double *centre, const double *limit,
                              const double *directions, int64_t least, double singular, double *found, double *slopes) {
    for (int64_t i = 0; i < n; i++, axes += 9, centre += 3, found += 4, slopes += 4) {
        double sectors[2 * CUTS][HALF_SUMS] = {{0}}, halves[2 * CUTS][HALF_SUMS] = {{0}}, all[HALF_SUMS], ignored[2];
        double explained[2 * CUTS], tilts[2 * CUTS][2], level = centre[0] * axes[0] + centre[1] * axes[3] + centre[2] * axes[6];
        for (const double *p = points + 3 * start[i]; p < points + 3 * start[i + 1]; p += 3) {
            const double u = p[0] * axes[2] + p[1] * axes[5] + p[2] * axes[8], v = p[0] * axes[1] + p[1] * axes[4] + p[2] * axes[7];
            const double r = p[0] * axes[0] + p[1] * axes[3] + p[2] * axes[6] - level;
            if (!(fabs(r) <= limit[i])) continue;
            const int turned = v > 0 || (v == 0 && u > 0), side = turned ? 1 : -1;
            int sector = turned ? CUTS : 0;    /* as many as there are cuts up to its direction */
            for (int k = 1; k < CUTS; k++) sector += side * (directions[2 * k] * v - directions[2 * k + 1] * u) >= 0;
            const double values[HALF_SUMS] = {1, u, v, r, u * u, u * v, v * v, u * r, v * r, r * r};
            for (int q = 0; q < HALF_SUMS; q++) sectors[sector][q] += values[q];
        }
        for (int k = 0; k < 2 * CUTS; k++) {
            for (int part = 0; part < CUTS; part++)
                for (int q = 0; q < HALF_SUMS; q++) halves[k][q] += sectors[(k + part) % (2 * CUTS)][q];
            explained[k] = explain_heights(halves[k], least, singular, tilts[k]);
        }
        int best = 0;
        for (int k = 1; k < CUTS; k++)
            if (explained[k] + explained[k + CUTS] > explained[best] + explained[best + CUTS]) best = k;
        for (int q = 0; q < HALF_SUMS; q++) all[q] = halves[0][q] + halves[CUTS][q];
        found[0] = all[0];
        found[1] = all[9];
        found[2] = explain_heights(all, least, singular, ignored);
        found[3] = explained[best] + explained[best + CUTS];
        memcpy(slopes, tilts[best], sizeof tilts[best]);
        memcpy(slopes + 2, tilts[best + CUTS], sizeof tilts[best]);
    }
    return 0;
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
