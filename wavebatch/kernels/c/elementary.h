/* Elementary functions and small systems of equations for Python: NumPy's depend on the processor and on its BLAS. */

INLINE int64_t exponentials_any(int64_t n, const double *x, double *out) {
    int64_t i = has_sixteen ? exponentials_eight(n, x, out) : 0;
    i += exponentials_wide(n - i, x + i, out + i);
    for (; i < n; i++) out[i] = exp_double(x[i]);
    return 0;
}
OFFER(exponentials, (int64_t n, const double *x, double *out), (n, x, out))

INLINE int64_t logarithms_any(int64_t n, const double *x, double *out) {
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) {
        const wide a = *(const wide *)(x + i);
        const wide_bits normal = (a >= 2.2250738585072014e-308) & (a < INFINITY);
        if (normal[0] & normal[1] & normal[2] & normal[3]) *(wide *)(out + i) = log_wide(a);
        else for (int64_t j = i; j < i + LANES; j++) out[j] = log_double(x[j]);
    }
    for (; i < n; i++) out[i] = log_double(x[i]);
    return 0;
}
OFFER(logarithms, (int64_t n, const double *x, double *out), (n, x, out))

/* Solves a symmetric positive definite system of n unknowns for m right-hand sides, (m, n), in place. */
EXPORT int64_t solve_equations(int64_t n, int64_t m, double *matrix, double *right) {
    double *pivot = malloc((n + 1) * sizeof(double));
    if (!pivot) return -1;
    factor(n, matrix, pivot, 0);
    for (int64_t i = 0; i < m; i++) solve(n, matrix, right + i * n);
    free(pivot);
    return 0;
}

/* m columns of a table of k rows, (k, m), linear between its ascending abscissas and level beyond: as NumPy's interp. */
static void interpolate_row(double x, int64_t k, int64_t m, const double *at, const double *table, double *restrict out) {
    int64_t low = 0, high = k;                 /* the last row at or before x */
    while (high - low > 1) {
        int64_t middle = (low + high) / 2;
        if (x >= at[middle]) low = middle;
        else high = middle;
    }
    const double *here = table + low * m;
    const int level = x <= at[low] || low + 1 == k;
    const double step = level ? 1 : at[low + 1] - at[low], way = x - at[low];
    for (int64_t c = 0; c < m; c++) out[c] = isnan(x) ? x : level ? here[c] : (here[m + c] - here[c]) / step * way + here[c];
}

EXPORT int64_t interpolate_columns(int64_t n, const double *x, int64_t k, int64_t m, const double *at, const double *table, double *out) {
    for (int64_t i = 0; i < n; i++) interpolate_row(x[i], k, m, at, table, out + i * m);
    return 0;
}

/* Sum of products, added in the order of NumPy's einsum on x86. */
static double sum_products(int64_t n, const double *a, const double *b) {
    double even = 0, odd = 0;
    int64_t i = 0;
    for (; i + 8 <= n; i += 8)
        for (int64_t j = i + 6; j >= i; j -= 2) {
            even += a[j] * b[j];
            odd += a[j + 1] * b[j + 1];
        }
    for (; i < n; i += 2) {
        even += a[i] * b[i];
        if (i + 1 < n) odd += a[i + 1] * b[i + 1];
    }
    return even + odd;
}

/* Variances of r sums of samples with these weights, (r, s), in noise of variance 1 with k correlations from lag 1 on. */
EXPORT int64_t coloured_variance(int64_t r, int64_t s, const double *weights, int64_t k, const double *correlation, double *variance) {
    for (int64_t i = 0; i < r; i++, weights += s) {
        variance[i] = sum_products(s, weights, weights);
        for (int64_t lag = 1; lag <= k && lag < s; lag++)
            variance[i] += 2 * correlation[lag - 1] * sum_products(s - lag, weights + lag, weights);
    }
    return 0;
}

/* What coloured noise makes of the errors of a fit of one echo, and what a wrong level does: of amplitude, time, width and energy.
   `joint` has the pulse and its derivatives, (3, s). The whole pulse's amplitude and time change with the width by these. */
EXPORT int64_t fit_factors(int64_t s, const double *joint, double amplitude_by_width, double time_by_width, const double *taps,
                           int64_t k, const double *correlation, double *factors, double *by_level) {
    const int64_t n = taps ? s + 2 : s;        /* a whitening filter reaches two samples further */
    double *seen = calloc(7 * n + 4 * s, sizeof(double)), *whole = seen + 3 * n, *weights = whole + 4 * n;
    double matrix[9], pivot[3], given[4];
    if (!seen) return -1;
    for (int i = 0; i < 3; i++)
        for (int64_t j = 0; j < s; j++)
            for (int later = 0; later <= n - s; later++) seen[i * n + j + later] += joint[i * s + j] * (taps ? taps[later] : 1);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) matrix[3 * i + j] = sum_products(n, seen + i * n, seen + j * n);
    factor(3, matrix, pivot, 0);
    for (int64_t j = 0; j < n; j++) {
        double one[3] = {seen[j], seen[n + j], seen[2 * n + j]};
        solve(3, matrix, one);
        whole[3 * n + j] = one[0] + one[2];    /* of the energy: amplitude and width change by the same share */
        whole[j] = one[0] + amplitude_by_width * one[2];
        whole[n + j] = one[1] + time_by_width * one[2];
        whole[2 * n + j] = one[2];
    }
    for (int i = 0; i < 4; i++) {
        given[i] = sum_products(n, whole + i * n, whole + i * n);
        by_level[i] = 0;
        for (int64_t j = 0; j < s; j++) {
            double weight = 0;
            for (int later = 0; later <= n - s; later++) weight += whole[i * n + j + later] * (taps ? taps[later] : 1);
            weights[i * s + j] = weight;
            by_level[i] += weight;
        }
        by_level[i] /= sqrt(given[i]);
    }
    coloured_variance(4, s, weights, k, correlation, factors);
    for (int i = 0; i < 4; i++) factors[i] /= given[i];
    free(seen);
    return 0;
}
