/* Elementary functions and small systems of equations for Python: NumPy's depend on the processor and on its BLAS. */

EXPORT int64_t exponentials(int64_t n, const double *x, double *out) {
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) *(wide *)(out + i) = exp_wide(*(const wide *)(x + i));
    for (; i < n; i++) out[i] = exp_double(x[i]);
    return 0;
}

EXPORT int64_t logarithms(int64_t n, const double *x, double *out) {
    for (int64_t i = 0; i < n; i++) out[i] = log_double(x[i]);
    return 0;
}

/* Solves a symmetric positive definite system of n unknowns for m right-hand sides, (m, n), in place. */
EXPORT int64_t solve_equations(int64_t n, int64_t m, double *matrix, double *right) {
    double *pivot = malloc((n + 1) * sizeof(double));
    if (!pivot) return -1;
    factor(n, matrix, pivot, 0);
    for (int64_t i = 0; i < m; i++) solve(n, matrix, pivot, right + i * n);
    free(pivot);
    return 0;
}
