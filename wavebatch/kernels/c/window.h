/* The samples of a cluster, ready to be fitted. */

static const float OUTSIDE = -1e6f;            /* position of a sample that takes no part: every pulse is 0 there */

/* Counts i .. i + n - 1 of a block as floats. */
static void read_counts(const Block *block, int64_t i, int64_t n, float *restrict out) {
    const uint8_t *bytes = (const uint8_t *)block->samples + i;
    const uint16_t *words = (const uint16_t *)block->samples + i;
    const uint32_t *longs = (const uint32_t *)block->samples + i;
    if (block->bytes == 1) for (int64_t x = 0; x < n; x++) out[x] = bytes[x];
    else if (block->bytes == 2) for (int64_t x = 0; x < n; x++) out[x] = words[x];
    else if (block->bytes == 4) for (int64_t x = 0; x < n; x++) out[x] = longs[x];
    else memcpy(out, (const float *)block->samples + i, n * sizeof(float));
}

/* Takes the level of samples i .. of a waveform off. */
static void take_level(const Block *block, int64_t waveform, int64_t i, int64_t n, float *restrict y) {
    const float *levels = block->baseline + (block->baseline_per_sample ? i : waveform), level = *levels;
    if (block->baseline_per_sample) for (int64_t x = 0; x < n; x++) y[x] -= levels[x];
    else for (int64_t x = 0; x < n; x++) y[x] -= level;
}

/* Noise without signal over noise at each sample: var = std^2 + gain * signal, from the smoothed signal, H12. */
static void weigh(Window *w, double gain) {
    const float *y = (const float *)w->y, share = gain / (w->std * w->std);
    float *weight = (float *)w->weight;
    for (int64_t i = 0; i < w->vectors * LANES; i++) {
        int64_t place[5];
        for (int d = 0; d < 5; d++) {
            int64_t at = i + d - 2;
            place[d] = at < 0 ? 0 : at >= w->n ? w->n - 1 : at;
        }
        float smooth = (y[place[0]] + y[place[4]] + 4 * (y[place[1]] + y[place[3]]) + 6 * y[place[2]]) / 16;
        weight[i] = 1 / sqrtf(1 + share * (smooth > 0 ? smooth : 0));
    }
}

/* Whitening as an autoregression of order 2: of each sample less what the two before it predict. The first samples, and
   those after a gap, are predicted from as many as there are (rows of the Cholesky factor), so that nothing is lost.
   Clipped samples are gaps whatever the model: where they came and went, chi2 would jump. */
static void set_filter(const Settings *s, Window *w) {
    const int64_t room = w->vectors * LANES;
    const float *x = (const float *)w->x, *clipped = (const float *)w->clipped;
    float *filter = (float *)w->filter;
    int64_t before = 0;
    for (int64_t i = 0; i < room; i++) {
        int is_clipped = w->any_clipped && clipped[i] != 0, is_there = i < w->n && x[i] >= 0;
        if (is_clipped) before = 0;
        for (int64_t j = 0; j < 3; j++) filter[j * room + i] = is_there ? s->whitening[before][j] : 0;
        before = !is_there || is_clipped ? 0 : before < 2 ? before + 1 : 2;
    }
}

/* A row filtered in place, from its end. */
INLINE void whiten(const Window *w, lanes *row) {
    const int64_t n = w->vectors;
    for (int64_t v = n - 1; v >= 0; v--) {
        const lanes here = row[v], left = v > 0 ? row[v - 1] : ALL(0);
        const lanes one = {left[3], here[0], here[1], here[2]}, two = {left[2], left[3], here[0], here[1]};
        row[v] = here * w->filter[v] + one * w->filter[n + v] + two * w->filter[2 * n + v];
    }
}

/* The transpose of weights and filter: a whitened row's product with a new pulse, whitened, is that of the row filtered
   back with the pulse as it is. */
static void filter_back(const Window *w, const lanes *row, lanes *out) {
    const int64_t room = w->vectors * LANES;
    const float *from = (const float *)row, *filter = (const float *)w->filter;
    float *to = (float *)out;
    for (int64_t i = 0; i < room; i++) {
        to[i] = filter[i] * from[i];
        if (i + 1 < room) to[i] += filter[room + i + 1] * from[i + 1];
        if (i + 2 < room) to[i] += filter[2 * room + i + 2] * from[i + 2];
    }
    for (int64_t v = 0; v < w->vectors && w->is_weighted; v++) out[v] *= w->weight[v];
}

/* Takes off a row what an error of the level may be of it; 2 - l'l `times` is as good as twice. */
INLINE void take_level_off(const Window *w, double times, lanes *row) {
    if (!(w->level_share > 0)) return;
    const float share = times * multiply(w->vectors, row, w->level);
    for (int64_t v = 0; v < w->vectors; v++) row[v] -= w->level[v] * share;
}

/* An error of the level is noise of the covariance u u' error^2, where u is the whitened row of ones. The root of the
   inverse of that and white noise is I - l l', with l along u. Clipped samples are known from nothing. */
static void free_level(double error, Window *w) {
    for (int64_t v = 0; v < w->vectors; v++) {
        w->level[v] = pick(w->x[v] >= 0.f, ALL(1), ALL(0));
        if (w->any_clipped) w->level[v] = pick(w->clipped[v] != 0.f, ALL(0), w->level[v]);
        if (w->is_weighted) w->level[v] *= w->weight[v];
    }
    if (w->is_whitened) whiten(w, w->level);
    const double square = multiply(w->vectors, w->level, w->level);
    if (!(square > 0)) return;
    w->level_share = 1 - 1 / sqrt(1 + error * error * square / (w->std * w->std));
    const float scale = sqrt(w->level_share / square);
    for (int64_t v = 0; v < w->vectors; v++) w->level[v] *= scale;
}

/* Cuts samples low .. high - 1 of a waveform, above its baseline. */
static void cut_window(const Block *block, const Settings *s, int64_t waveform, int64_t low, int64_t high, Window *w) {
    float *y = (float *)w->y, *x = (float *)w->x, *clipped = (float *)w->clipped;
    const int64_t first = waveform * block->length + low, n = high - low;
    const float top = s->clip, floor = s->floor;
    w->begin = low; w->n = w->used = n; w->vectors = VECTORS(n); w->std = block->std[waveform];
    w->any_clipped = 0; w->is_weighted = s->noise_gain > 0;
    read_counts(block, first, n, y);
    for (int64_t i = 0; i < n; i++) x[i] = i;
    for (int64_t i = 0; i < n; i++) w->any_clipped |= (y[i] >= top) | (y[i] <= floor);
    for (int64_t i = 0; i < n && w->any_clipped; i++) clipped[i] = (y[i] >= top) - (y[i] <= floor);
    take_level(block, waveform, first, n, y);
    for (int64_t i = 0; i < n && block->missing; i++)
        if (block->missing[first + i]) { y[i] = 0; x[i] = OUTSIDE; clipped[i] = 0; w->used--; }
    for (int64_t i = n; i < w->vectors * LANES; i++) { y[i] = 0; x[i] = OUTSIDE; clipped[i] = 0; }
    if (w->is_weighted) weigh(w, s->noise_gain);
    w->is_whitened = s->whitened;
    if (w->is_whitened) set_filter(s, w);
    w->level_share = 0;
    if (s->free_levels && block->level_err && block->level_err[waveform] > 0) free_level(block->level_err[waveform], w);
}
