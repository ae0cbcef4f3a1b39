/* Elementary functions and small systems of equations for Python: NumPy's depend on the processor and on its BLAS. */

INLINE int64_t exponentials_any(int64_t n, const double *x, double *out) {
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) *(wide *)(out + i) = exp_wide(*(const wide *)(x + i));
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
    for (int64_t i = 0; i < m; i++) solve(n, matrix, pivot, right + i * n);
    free(pivot);
    return 0;
}

/* m columns of a table of k rows, (k, m), linear between its ascending abscissas and level beyond: as NumPy's interp. */
static void interpolate_row(double x, int64_t k, int64_t m, const double *at, const double *table, double *out) {
    int64_t low = 0, high = k;                 /* the last row at or before x */
    while (high - low > 1) {
        int64_t middle = (low + high) / 2;
        if (x >= at[middle]) low = middle;
        else high = middle;
    }
    const double *here = table + low * m;
    const int level = x <= at[low] || low + 1 == k;
    for (int64_t c = 0; c < m; c++)
        out[c] = isnan(x) ? x : level ? here[c] : (here[m + c] - here[c]) / (at[low + 1] - at[low]) * (x - at[low]) + here[c];
}

EXPORT int64_t interpolate_columns(int64_t n, const double *x, int64_t k, int64_t m, const double *at, const double *table, double *out) {
    for (int64_t i = 0; i < n; i++) interpolate_row(x[i], k, m, at, table, out + i * m);
    return 0;
}
