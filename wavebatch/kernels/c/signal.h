/* Before the fit: levels, maxima and clusters of whole waveforms, docs/algorithms.md 1.1, 4.2 and H10. */

typedef struct { /* candidates of waveforms; `room` of them fit */
    int64_t room;
    int64_t *waveform;
    double *amplitude, *time, *width;
} Candidates;

typedef struct {
    double threshold;                          /* least height in noise of one sample */
    double width_ref, broad;                   /* of the pulse; of the Gaussian `taps`, 0 for [1 2 1]/4 twice */
    const float *taps;                         /* half of a filter: the centre first */
    int64_t reach;
} Detector;

typedef struct { float *signal, *smoothed, *even; uint8_t *marks; } Rows;

static void free_rows(Rows *r) { free(r->signal); free(r->smoothed); free(r->even); free(r->marks); }

static int reserve_rows(Rows *r, int64_t s) {
    return enlarge(&r->signal, s * sizeof(float)) && enlarge(&r->smoothed, s * sizeof(float)) && enlarge(&r->even, s * sizeof(float))
        && enlarge(&r->marks, s + 8);
}

/* [1 2 1]/4 along the samples; the end samples are repeated outwards. */
static void smooth_121(int64_t s, const float *restrict x, float *restrict out) {
    for (int64_t i = 1; i + 1 < s; i++) out[i] = ((x[i - 1] + x[i + 1]) + x[i] + x[i]) * 0.25f;
    int64_t last = s - 1, next = s > 1, before = s > 1 ? s - 2 : 0;
    out[0] = ((x[0] + x[next]) + x[0] + x[0]) * 0.25f;
    out[last] = ((x[last] + x[before]) + x[last] + x[last]) * 0.25f;
}

INLINE void add_scaled(int64_t n, float tap, const float *restrict x, float *restrict out) {
    for (int64_t i = 0; i < n; i++) out[i] += tap * x[i];
}

/* A waveform correlated with symmetric taps, 0 outside of it: neighbours are added before they are weighted. */
static void filter_waveform(int64_t s, const float *restrict x, const float *taps, int64_t reach, float *restrict out) {
    for (int64_t i = 0; i < s; i++) out[i] = taps[0] * x[i];
    for (int64_t d = 1; d <= reach && d < s; d++) {
        const int64_t both = s - 2 * d, alone = both < 0 ? s - d : d;
        add_scaled(alone, taps[d], x + d, out);
        for (int64_t i = d; i < d + both; i++) out[i] += taps[d] * (x[i - d] + x[i + d]);
        add_scaled(alone, taps[d], x + s - d - alone, out + s - alone);
    }
}

/* The same for `rows` of `length` samples in which those of a waveform are `unit` apart: neighbours are weighted first.
   A few samples at a time, so that they stay in the processor's cache for all taps. */
INLINE int64_t filter_rows_any(const float *signal, int64_t rows, int64_t length, int64_t unit, const float *taps, int64_t reach, float *out) {
    enum { TOGETHER = 2048 };
    for (int64_t r = 0; r < rows; r++, signal += length, out += length)
        for (int64_t begin = 0; begin < length; begin += TOGETHER) {
            const int64_t end = begin + TOGETHER < length ? begin + TOGETHER : length;
            for (int64_t i = begin; i < end; i++) out[i] = taps[0] * signal[i];
            for (int64_t away = unit, d = 1; d <= reach && away < length; d++, away += unit) {
                const int64_t from = away > begin ? away : begin, to = length - away < end ? length - away : end;
                add_scaled(end - from, taps[d], signal + from - away, out + from);
                add_scaled(to - begin, taps[d], signal + begin + away, out + begin);
            }
        }
    return 0;
}
OFFER(filter_rows, (const float *signal, int64_t rows, int64_t length, int64_t unit, const float *taps, int64_t reach, float *out),
      (signal, rows, length, unit, taps, reach, out))

/* A waveform above its level, with 0 where no sample was recorded, and the mean of its neighbours for a single one: an
   echo across it is one. Returns whether its counts differ. */
static int read_signal(const Block *b, int64_t waveform, float *signal) {
    const int64_t s = b->length, first = waveform * s;
    int varies = 0;
    read_counts(b, first, s, signal);
    for (int64_t i = 1; i < s; i++) varies |= signal[i] != signal[0];
    take_level(b, waveform, first, s, signal);
    for (int64_t i = 0; i < s && b->missing; i++)
        if (b->missing[first + i]) signal[i] = 0;
    for (int64_t i = 1; i < s - 1 && b->missing; i++) {
        const uint8_t *gap = b->missing + first + i;
        if (gap[0] && !gap[-1] && !gap[1]) signal[i] = 0.5f * (signal[i - 1] + signal[i + 1]);
    }
    return varies;
}

/* Sum of the recorded samples from .. to - 1 of a waveform, in four parts; adds their number to `found`. */
static double sum_recorded(const float *signal, const uint8_t *missing, int64_t from, int64_t to, int64_t *found) {
    double sum[LANES] = {0};
    int64_t i = from;
    for (; i + LANES <= to && !missing; i += LANES) {
        for (int64_t q = 0; q < LANES; q++) sum[q] += signal[i + q];
        *found += LANES;
    }
    for (; i < to; i++)
        if (!missing || !missing[i]) { sum[0] += signal[i]; ++*found; }
    return (sum[0] + sum[2]) + (sum[1] + sum[3]);
}

/* The next mark from sample i on, s without one; `marks` has eight zeros after the last. */
INLINE int64_t next_mark(int64_t s, const uint8_t *marks, int64_t i) {
    for (uint64_t eight; i < s; i++) {
        memcpy(&eight, marks + i, sizeof eight);
        if (!eight) i += 7;
        else if (marks[i]) return i;
    }
    return s;
}

/* Samples that are far from any signal: neither within `reach` of a smoothed sample beyond +-limit, nor within `recovery`
   after one beyond three times that. Their mean above the baseline and their number, H10. */
EXPORT int64_t quiet_levels(const Block *b, int64_t n, double limit, int64_t reach, int64_t recovery, float *mean, int32_t *number) {
    const int64_t s = b->length, after = recovery > reach ? recovery : reach;
    const float busy = limit, strong = 3 * busy;
    Rows r = {0};
    int good = reserve_rows(&r, s);
    for (int64_t w = 0; w < n && good; w++) {
        const uint8_t *missing = b->missing ? b->missing + w * s : NULL;
        int64_t from = 0, found = 0; /* the first sample that no signal before it reaches */
        double total = 0;
        read_counts(b, w * s, s, r.signal);
        take_level(b, w, w * s, s, r.signal);
        smooth_121(s, r.signal, r.smoothed);
        for (int64_t i = 0; i < s; i++) r.marks[i] = fabsf(r.smoothed[i]) > busy;
        memset(r.marks + s, 0, 8);
        for (int64_t i = next_mark(s, r.marks, 0); i < s; i = next_mark(s, r.marks, i + 1)) {
            const float height = fabsf(r.smoothed[i]);
            if (i - reach > from) total += sum_recorded(r.signal, missing, from, i - reach, &found);
            const int64_t next = i + 1 + (height > strong ? after : reach);
            from = next > from ? next : from;
        }
        if (from < s) total += sum_recorded(r.signal, missing, from, s, &found);
        mean[w] = found ? total / found : 0;
        number[w] = found;
    }
    free_rows(&r);
    return good ? 0 : -1;
}

typedef struct { float width, extra, strong; int64_t reach, recovery, least; } Quiet; /* as for find_levels in kernels/signal/noise.py */

/* Which samples of a waveform above `level` are quiet; their mean, 0 without any, and number. */
static float mean_of_quiet(int64_t s, const float *y, float level, float busy, const Quiet *q, int64_t recovery, Rows *r, int64_t *number) {
    int64_t done = 0;                          /* samples before it are decided */
    float total = 0;
    for (int64_t i = 0; i < s; i++) r->even[i] = y[i] - level;
    smooth_121(s, r->even, r->smoothed);
    memset(r->marks, 1, s);
    for (int64_t i = 0; i < s; i++) {
        const float height = fabsf(r->smoothed[i]);
        if (!(height > busy)) continue;
        const int64_t begin = i - q->reach > done ? i - q->reach : done, far = i + 1 + (height > q->strong && recovery > q->reach ? recovery : q->reach);
        const int64_t end = far < s ? far : s;
        if (end > begin) memset(r->marks + begin, 0, end - begin);
        done = end > done ? end : done;
    }
    *number = 0;
    for (int64_t i = 0; i < s; i++) {
        total += r->even[i] * r->marks[i];
        *number += r->marks[i];
    }
    return total / (float)(*number > 0 ? *number : 1);
}

/* Levels of n waveforms from themselves alone, in place of first ones; their quiet samples (n, s), and the number of these among
   the first `counted`. */
EXPORT int64_t find_levels(int64_t n, int64_t s, const float *signal, const Quiet *q, const int64_t *counted,
                           float *level, uint8_t *quiet, int64_t *number) {
    Rows r = {0};
    const int good = reserve_rows(&r, s);
    for (int64_t w = 0; w < n && good; w++, signal += s, quiet += s) {
        for (int round = 0; round < 3; round++)
            level[w] += mean_of_quiet(s, signal, level[w], q->width + (round ? 0 : q->extra), q, 0, &r, number + w);
        memcpy(quiet, r.marks, s);
        if (q->recovery > q->reach) {
            int64_t found;
            const float mean = mean_of_quiet(s, signal, level[w], q->width, q, q->recovery, &r, &found);
            if (found >= q->least) {
                level[w] += mean;
                memcpy(quiet, r.marks, s);
            }
        }
        number[w] = 0;
        for (int64_t i = 0; i < counted[w]; i++) number[w] += quiet[i];
    }
    free_rows(&r);
    return good ? 0 : -1;
}

/* The peak by a parabola through the logarithms of five smoothed samples, weighted by the signal; the width of the filter
   [1 2 1]/4 is taken off. `width` where the parabola fails. docs/algorithms.md 4.1. */
static void start_of(int64_t s, const float *y, int64_t place, double *amplitude, double *time, double *width) {
    const double peak = y[place], floor = 0.05 * peak;
    double sum[5] = {0}, product[3] = {0};
    for (int d = -2; d <= 2; d++) {
        int64_t at = place + d;
        if (at < 0 || at >= s || !(y[at] > floor)) continue;
        double weight = (double)y[at] * y[at], value = weight * log_double(y[at]), power = 1;
        for (int q = 0; q < 5; q++, power *= d) {
            sum[q] += weight * power;
            if (q < 3) product[q] += value * power;
        }
    }
    double m0 = sum[2] * sum[4] - sum[3] * sum[3], m1 = sum[1] * sum[4] - sum[2] * sum[3], m2 = sum[1] * sum[3] - sum[2] * sum[2];
    double n1 = sum[0] * sum[4] - sum[2] * sum[2], n2 = sum[0] * sum[3] - sum[1] * sum[2];
    double determinant = sum[0] * m0 - sum[1] * m1 + sum[2] * m2, inverse = fabs(determinant) > 1e-12 ? 1 / determinant : 0;
    double c0 = (product[0] * m0 - product[1] * m1 + product[2] * m2) * inverse;
    double c1 = (-product[0] * m1 + product[1] * n1 - product[2] * n2) * inverse;
    double c2 = (product[0] * m2 - product[1] * n2 + product[2] * (sum[0] * sum[2] - sum[1] * sum[1])) * inverse;
    double shift = c2 < -1e-4 ? -c1 / (2 * c2) : 2;
    *time = place; *amplitude = 1.1 * peak;
    if (!(fabs(shift) < 1.5)) return;
    double narrow = sqrt(at_least(-1 / (2 * c2) - 0.5, 0.1));
    *time = place + shift;
    *amplitude = exp_double(at_most(at_least(c0 - c1 * c1 / (4 * c2), -20), 20)) * sqrt(1 + 0.5 / (narrow * narrow));
    *width = narrow;
}

/* Peaks with a neighbour: time and height by a parabola through the logarithms of three samples. */
static void refine_peak(int64_t s, const float *y, int64_t place, double *amplitude, double *time) {
    *time = place; *amplitude = y[place];
    if (place == 0 || place == s - 1 || !(y[place - 1] > 0 && y[place + 1] > 0)) return;
    double a = log_double(y[place - 1]), b = log_double(y[place]), c = log_double(y[place + 1]), curve = a - 2 * b + c;
    if (!(curve < -1e-12)) return;
    double shift = at_most(at_least(0.5 * (a - c) / curve, -0.5), 0.5);
    *time = place + shift;
    *amplitude = exp_double(b - 0.25 * (a - c) * shift);
}

/* Whether a local maximum begins at sample i: a plateau counts once, at its first sample, but not at the first of all. */
INLINE int is_peak(int64_t s, const float *y, int64_t i) {
    if (i == 0) return s > 1 && y[1] < y[0];
    int64_t ahead = i + 1;
    while (ahead < s && y[ahead] == y[i]) ahead++;
    return y[i] > y[i - 1] && (ahead == s || y[ahead] < y[i]);
}

/* Next local maximum from sample i on, s without one; `marks` has where one may begin. */
INLINE int64_t next_peak(int64_t s, const float *y, const uint8_t *marks, int64_t i) {
    for (i = next_mark(s, marks, i); i < s && !is_peak(s, y, i);) i = next_mark(s, marks, i + 1);
    return i;
}

/* Marks samples above `least` at which a local maximum may begin, without branches. */
static void mark_peaks(int64_t s, const float *restrict y, float least, uint8_t *restrict marks) {
    for (int64_t i = 1; i + 1 < s; i++) marks[i] = (y[i] > least) & (y[i] > y[i - 1]) & (y[i] >= y[i + 1]);
    marks[0] = y[0] > least;
    marks[s - 1] = y[s - 1] > least;
    memset(marks + s, 0, 8);
}

/* Local maxima of smoothed waveforms `from` to n - 1 with starts for the fit, until their room ends: 1.1, max-detection.
   Returns the first waveform that is not done, and in `found` the number of maxima; -1 where there is no memory. */
INLINE int64_t find_maxima_any(const Block *b, int64_t n, const Detector *d, int64_t from, Candidates *out, int64_t *found) {
    const int64_t s = b->length;
    const double ref = d->width_ref;
    Rows r = {0};
    int64_t w = reserve_rows(&r, s) ? from : -1, total = 0;
    for (; w >= 0 && w < n; w++) {
        const float least = (float)d->threshold * b->std[w];
        int64_t here = total;
        int is_high = 0;
        if (!read_signal(b, w, r.signal)) continue;
        if (d->broad > 0) filter_waveform(s, r.signal, d->taps, d->reach, r.smoothed);
        else smooth_121(s, r.signal, r.smoothed);
        for (int64_t i = 0; i < s; i++) is_high |= r.smoothed[i] > least;
        if (!is_high) continue; /* one more pass only lowers it */
        if (d->broad > 0) memcpy(r.even, r.smoothed, s * sizeof(float));
        else smooth_121(s, r.smoothed, r.even);
        mark_peaks(s, r.even, least, r.marks);
        for (int64_t i = next_peak(s, r.even, r.marks, 0); i < s && here < out->room; i = next_peak(s, r.even, r.marks, i + 1)) {
            out->waveform[here] = w;
            out->time[here++] = i;
        }
        if (here == out->room) break;
        double after = INFINITY;
        for (int64_t j = here - 1; j >= total; j--) {
            int64_t place = (int64_t)out->time[j];
            double before = j > total ? place - out->time[j - 1] : INFINITY, gap = at_most(before, after), width = ref;
            after = before;
            start_of(s, r.smoothed, place, &out->amplitude[j], &out->time[j], &width);
            if (gap < 4 * ref) refine_peak(s, r.smoothed, place, &out->amplitude[j], &out->time[j]);
            width = at_most(width, 0.5 * gap);
            if (d->broad > 0) {
                width = sqrt(at_least(width * width - d->broad * d->broad, 0.25 * ref * ref));
                out->amplitude[j] *= sqrt(1 + d->broad * d->broad / (width * width));
            }
            out->width[j] = at_most(at_least(width, 0.7 * ref), 4 * ref);
        }
        total = here;
    }
    free_rows(&r);
    *found = total;
    return w;
}
OFFER(find_maxima, (const Block *b, int64_t n, const Detector *d, int64_t from, Candidates *out, int64_t *found), (b, n, d, from, out, found))

static const double RUN_LEVEL = 2;             /* of a run, in noise of the smoothed signal: echoes on one are one cluster */

typedef struct { int64_t margin, reach, most; const int64_t *tail; } Grouping;
typedef struct { int64_t *waveform, *low, *high, *first, *number; } Groups;

/* The run of signal above the noise that each of m candidates of one waveform stands on, and its sample. */
static void find_extents(int64_t s, const float *smoothed, float level, int64_t m, const double *time, const int64_t *tail, int64_t *at,
                         int64_t *low, int64_t *high) {
    for (int64_t i = 0; i < m; i++) {
        int64_t place = (int64_t)rint(at_most(at_least(time[i], 0), s - 1)), begin = place, end = place + 1;
        if (smoothed[place] > level) {
            if (i && place < high[i - 1] && place >= low[i - 1]) { begin = low[i - 1]; end = high[i - 1]; } /* the same run */
            while (begin > 0 && smoothed[begin - 1] > level) begin--;
            while (end < s && smoothed[end] > level) end++;
        }
        at[i] = place; low[i] = begin; high[i] = end;
    }
    for (int64_t i = 0; i < m && tail; i++)
        if (at[i] + tail[i] > high[i]) high[i] = at[i] + tail[i];
}

/* Candidates i .. end - 1 of one waveform as clusters, whose windows do not overlap; returns the number of clusters. Those
   closer than an echo reaches are fitted together where noise cuts their run: faint broad echoes may have two maxima. */
static int64_t group_waveform(const Grouping *g, int64_t s, int64_t waveform, int64_t i, int64_t end, const int64_t *at, const int64_t *low,
                              const int64_t *high, Groups *out, int64_t number) {
    int64_t furthest = 0, run = 0, before = -1;
    for (int64_t j = i; j < end; j++) {
        int joined = j > i && (low[j] < furthest || at[j] - at[j - 1] < g->reach);
        run = joined ? run + 1 : 0;
        if (!joined || run % g->most == 0) {
            int64_t first = low[j] - g->margin < at[j] - g->reach ? low[j] - g->margin : at[j] - g->reach;
            if (before >= 0) { /* windows are cut half-way between the signals, or between candidates where signals meet */
                int64_t here = at[j - 1] + 1, most = at[j] > here ? at[j] : here;
                int64_t middle = (low[j] >= furthest ? low[j] + furthest : at[j] + here) / 2;
                middle = middle < here ? here : middle > most ? most : middle;
                if (out->high[before] > middle) out->high[before] = middle;
                if (first < middle) first = middle;
            }
            first = first < 0 ? 0 : first;
            out->waveform[number] = waveform; out->first[number] = j; out->number[number] = 0;
            out->low[number] = first < at[j] ? first : at[j];
            before = number++;
        }
        if (high[j] > furthest) furthest = high[j];
        int64_t last = furthest + g->margin > at[j] + 1 + g->reach ? furthest + g->margin : at[j] + 1 + g->reach;
        out->high[before] = last > s ? s : last;
        out->number[before]++;
    }
    return number;
}

/* Joins m candidates, sorted by waveform and time, that stand on one run of signal above the noise: 4.2. A window that
   reaches into its neighbour finds false echoes there. Returns the number of clusters; -1 where there is no memory. */
INLINE int64_t group_candidates_any(const Block *b, int64_t m, const int64_t *waveform, const double *time, const Grouping *g, Groups *out) {
    const int64_t s = b->length;
    Rows r = {0};
    int64_t number = 0, *at = NULL, *low = NULL, *high = NULL;
    size_t size = (m + 1) * sizeof(int64_t);
    int good = reserve_rows(&r, s) && enlarge(&at, size) && enlarge(&low, size) && enlarge(&high, size);
    for (int64_t i = 0, end; i < m && good; i = end) {
        for (end = i + 1; end < m && waveform[end] == waveform[i];) end++;
        const float level = (float)(RUN_LEVEL * SMOOTH_GAIN) * b->std[waveform[i]];
        read_signal(b, waveform[i], r.signal);
        smooth_121(s, r.signal, r.smoothed);
        find_extents(s, r.smoothed, level, end - i, time + i, g->tail ? g->tail + i : NULL, at + i, low + i, high + i);
        number = group_waveform(g, s, waveform[i], i, end, at, low, high, out, number);
    }
    free_rows(&r);
    free(at); free(low); free(high);
    return good ? number : -1;
}
OFFER(group_candidates, (const Block *b, int64_t m, const int64_t *waveform, const double *time, const Grouping *g, Groups *out), (b, m, waveform, time, g, out))

static const float FAR_ABOVE = 2.2f;           /* noises, and half of the tails, that a candidate lies above them where it is another echo */

typedef struct { /* what an echo of amplitude 1 leaves at n lags, from `first` on, `step` apart [samples] */
    int64_t n, after;                          /* lags; the one of 0 */
    double first, step;
    const double *value, *highest;             /* from each lag after 0 on: the largest size, (n - after) */
} Tail;

static double tail_at(const Tail *t, double lag) {
    const double place = rint((lag - t->first) / t->step);
    return place >= 0 && place < t->n ? t->value[(int64_t)place] : 0;
}

/* Which of m candidates, sorted by waveform and time, are more than tails of up to `most` others on each side, or than `quiet`
   noises; and how far the tail of each exceeds the noise [samples]. */
EXPORT int64_t explain_tails(int64_t m, const int64_t *waveform, const double *time, const double *amplitude, const float *std,
                             const Tail *t, int64_t most, float quiet, uint8_t *kept, int64_t *reach) {
    for (int64_t i = 0; i < m; i++) {
        const float noise = std[waveform[i]];
        double expected = 0;
        for (int64_t step = 1; step <= most; step++) {
            const int64_t earlier = i - step, later = i + step;
            const int before = earlier >= 0 && waveform[earlier] == waveform[i], behind = later < m && waveform[later] == waveform[i];
            if (before) expected += amplitude[earlier] * tail_at(t, time[i] - time[earlier]);
            if (behind) expected += amplitude[later] * tail_at(t, time[i] - time[later]);
            if (!before && !behind) break;
        }
        kept[i] = amplitude[i] - expected > FAR_ABOVE * noise + 0.5 * expected || expected <= quiet * noise;
        const double least = 1 / at_least(amplitude[i] / noise, 1e-9);
        int64_t low = 0, high = t->n - t->after; /* the first lag from which the tail is in the noise */
        while (low < high) {
            const int64_t middle = (low + high) / 2;
            if (t->highest[middle] <= least) high = middle;
            else low = middle + 1;
        }
        reach[i] = (int64_t)ceil(low * t->step);
    }
    return 0;
}
