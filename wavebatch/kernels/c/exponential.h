/* e^a in double precision, error 2e-16 of the value: NumPy's depends on the processor.

   lanes.h includes this file for four numbers at a time, pulse.h for eight. Each goes through the same operations, so the
   bits are the same. */

/* The sum with 1.5 * 2^52 rounds to a whole number n and has it in its last bits; the factors are 1 / i!. */
INLINE TARGET ROW OF(exp)(ROW a) {
    static const double FACTOR[] = {1.0 / 6227020800, 1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320,
                                    1.0 / 5040, 1.0 / 720, 1.0 / 120, 1.0 / 24, 1.0 / 6, 1.0 / 2, 1, 1};
    BITS in_range = (a > -708) & (a <= 709);
    ROW inside = (ROW)((BITS)a & in_range), whole = inside * 1.4426950408889634 + 6755399441055744.0, n = whole - 6755399441055744.0;
    ROW r = inside - n * 6.93147180369123816490e-01 - n * 1.90821492927058770002e-10, sum = {0};
    for (int i = 0; i < 14; i++) sum = sum * r + FACTOR[i]; /* e^r, |r| <= ln(2) / 2, by Horner */
    ROW value = sum * (ROW)(((BITS)whole + 1023) << 52), beyond = (ROW)((a > 709) & (BITS)((ROW){0} + INFINITY));
    ROW other = (ROW)(((BITS)a & (a != a)) | ((BITS)beyond & (a == a)));
    return (ROW)((in_range & (BITS)value) | (~in_range & (BITS)other));
}

/* Those of as many of n numbers as fill whole rows; returns how many. */
static TARGET int64_t OF(exponentials)(int64_t n, const double *x, double *out) {
    const int64_t step = sizeof(ROW) / sizeof(double), end = n - n % step;
    for (int64_t i = 0; i < end; i += step) *(ROW *)(out + i) = OF(exp)(*(const ROW *)(x + i));
    return end;
}
