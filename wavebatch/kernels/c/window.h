/* The samples of a cluster, ready to be fitted. */

static const float OUTSIDE = -1e6f;            /* position of a sample that takes no part: every pulse is 0 there */

INLINE float count_at(const Block *block, int64_t i) {
    switch (block->bytes) {
        case 1: return ((const uint8_t *)block->samples)[i];
        case 2: return ((const uint16_t *)block->samples)[i];
        case 4: return ((const uint32_t *)block->samples)[i];
        default: return ((const float *)block->samples)[i];
    }
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

/* Cuts samples low .. high - 1 of a waveform, above its baseline. */
static void cut_window(const Block *block, const Settings *s, int64_t waveform, int64_t low, int64_t high, Window *w) {
    float *y = (float *)w->y, *x = (float *)w->x, *clipped = (float *)w->clipped;
    int64_t first = waveform * block->length;
    w->begin = low; w->n = high - low; w->vectors = VECTORS(w->n);
    w->used = w->n; w->std = block->std[waveform];
    w->any_clipped = 0; w->is_weighted = s->noise_gain > 0;
    for (int64_t i = 0; i < w->n; i++) {
        int64_t at = first + low + i;
        float count = count_at(block, at);
        y[i] = count - block->baseline[block->baseline_per_sample ? at : waveform];
        x[i] = i;
        clipped[i] = count >= s->clip;
        w->any_clipped |= count >= s->clip;
        if (block->missing && block->missing[at]) { y[i] = 0; x[i] = OUTSIDE; clipped[i] = 0; w->used--; }
    }
    for (int64_t i = w->n; i < w->vectors * LANES; i++) { y[i] = 0; x[i] = OUTSIDE; clipped[i] = 0; }
    if (w->is_weighted) weigh(w, s->noise_gain);
}
