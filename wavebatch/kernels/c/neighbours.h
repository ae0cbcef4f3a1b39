/* Echoes beside others of their waveform, and over their samples: which ones errors of a stronger one explain, what those
   errors add, and flags. finish.h takes echoes through them; stages/flags.py and stages/decompose/merge.py have the reasons.

   Tables are sorted by waveform, then time. Columns are float32, and so are products with them. */

enum { NEIGHBOURS = 5 };                       /* each echo is compared with this many before and after it */
enum { FLAG_NEAR_EDGE = 4, FLAG_SATURATED = 8, FLAG_WEAK = 32, FLAG_NARROW = 128, FLAG_UNRELIABLE = 16384 };

typedef struct { int64_t n; const double *lag, *value; } Curve; /* lines between points, ascending; none where n is 0 */

typedef struct { /* which echoes are faint beside a stronger one */
    double share, nearest, furthest;           /* below this share of one at this distance before them */
    int64_t after;                             /* or after them */
    double top, clipped;                       /* below this share of one from `top` on, wherever it is */
    Curve tail;                                /* what a stronger echo leaves unexplained at a lag, over its amplitude */
    double close, apart;                       /* from a point of the curve, and between two, up to which it is known */
    double beside, factor, far_factor, known;  /* times the curve up to `beside` and beyond; errors above it */
} Faintness;

typedef struct { /* what fits leave unexplained */
    double core, misfit;                       /* distance, and share of the amplitude that is left up to there */
    double clear, beside;                      /* amplitude from which `left` counts, and its reach */
    double energy;                             /* of an echo of amplitude 1, in noise, over what it leaves */
    Curve left;
    double unit, spacing, variance;            /* energy of an echo is amplitude^2 sigma unit / spacing / variance */
    double misfit2, samples, limit;            /* chi2 per sample: expected by the energy over `samples`; above which it is no chance */
} Unexplained;

typedef struct {
    double spacing, last, sigma_ref, narrow;   /* last: time of the last sample; narrow: sigma below which an echo may be so */
    double level, reach, unreliable;           /* of clipping; widths around an echo; share of the amplitude under the level */
} Flagging;

INLINE int64_t end_of_waveform(const Table *t, int64_t i) {
    const int64_t waveform = t->waveform[i];
    while (i < t->m && t->waveform[i] == waveform) i++;
    return i;
}

/* Between two points of the curve that are near each other, or near one point; elsewhere nothing is left. */
static double tail_share(const Faintness *f, double lag) {
    const Curve *c = &f->tail;
    int64_t after = 0;
    double share;
    while (after < c->n && c->lag[after] < lag) after++;
    const int near = (after && lag - c->lag[after - 1] <= f->close) || (after < c->n && c->lag[after] - lag <= f->close);
    const int between = after && after < c->n && c->lag[after] - c->lag[after - 1] < f->apart;
    if (!near && !between) return 0;
    interpolate_row(lag, c->n, 1, c->lag, c->value, &share);
    return share;
}

static int is_faint(const Table *t, const Faintness *f, int64_t row, int64_t other) {
    const double lag = t->time[row] - t->time[other], gap = f->after ? fabs(lag) : lag;
    const float amplitude = t->amplitude[row], strong = t->amplitude[other], error = t->amplitude_err[row];
    if (gap >= f->nearest && gap <= f->furthest && amplitude < (float)f->share * strong) return 1;
    if (strong >= (float)f->top && amplitude < (float)f->clipped * strong) return 1;
    if (!f->tail.n) return 0;
    const double tail = tail_share(f, lag) * strong, sure = tail > 0 && error > 0 ? (float)f->known * error : 0;
    return amplitude < fmax((fabs(lag) < f->beside ? f->factor : f->far_factor) * tail, tail + sure);
}

/* Marks echoes that an error of another one of their waveform explains: of the nearest, and of the last ones before it that
   nothing explains, as many echoes of a ringing may lie between it and the strong one. */
static void find_faint(const Table *t, const Faintness *f, uint8_t *faint) {
    int64_t last[NEIGHBOURS], kept = 0;
    for (int64_t i = 0, end = 0; i < t->m; i++) {
        faint[i] = 0;
        if (i == end) { end = end_of_waveform(t, i); kept = 0; }
        for (int64_t j = i > NEIGHBOURS ? i - NEIGHBOURS : 0; j < end && j <= i + NEIGHBOURS && !faint[i]; j++)
            if (j != i && t->waveform[j] == t->waveform[i]) faint[i] = is_faint(t, f, i, j);
        for (int64_t k = 0; k < kept && k < NEIGHBOURS && !faint[i]; k++)
            if (last[k] < i - NEIGHBOURS) faint[i] = is_faint(t, f, i, last[k]);
        if (!faint[i]) last[kept++ % NEIGHBOURS] = i;
    }
}

/* chi2 per sample of each echo's fit over what is expected, 1 where chance explains it; and, unless NULL, what others of
   its waveform leave beside it, in its own variance. */
EXPORT int64_t weigh_fits(const Table *t, const Unexplained *u, double *unexplained, double *beside) {
    for (int64_t i = 0, end; i < t->m; i = end) {
        double energy = 0;
        end = end_of_waveform(t, i);
        for (int64_t j = i; j < end; j++) energy += (double)t->amplitude[j] * t->amplitude[j] * t->sigma[j];
        energy = energy * u->unit / u->spacing / u->variance;
        const double expected = 1 + u->misfit2 * energy / u->samples;
        for (int64_t j = i; j < end; j++) {
            const double residual = isnan(t->residual[j]) ? 0 : t->residual[j], chi2 = residual * residual / expected;
            unexplained[j] = chi2 > u->limit ? chi2 : 1;
        }
        for (int64_t j = i; j < end && beside; j++) {
            beside[j] = 0;
            for (int64_t k = j > i + NEIGHBOURS ? j - NEIGHBOURS : i; k < end && k <= j + NEIGHBOURS; k++) {
                const double lag = t->time[j] - t->time[k];
                const float strong = t->amplitude[k], core = fabs(lag) < u->core ? (float)u->misfit * strong : 0;
                double left = 0;
                if (k == j) continue;
                if (u->left.n && strong > (float)u->clear && fabs(lag) < u->beside) interpolate_row(lag, u->left.n, 1, u->left.lag, u->left.value, &left);
                beside[j] = at_least((float)u->energy * (core * core) + left, beside[j]);
            }
        }
    }
    return 0;
}

INLINE double count_at(const Block *b, int64_t i) {
    return b->bytes == 1 ? ((const uint8_t *)b->samples)[i] : b->bytes == 2 ? ((const uint16_t *)b->samples)[i]
        : b->bytes == 4 ? ((const uint32_t *)b->samples)[i] : ((const float *)b->samples)[i];
}

/* Whether a recorded sample from .. to of a waveform reaches a level. */
static int is_clipped(const Block *b, int64_t waveform, int64_t from, int64_t to, double level) {
    for (int64_t i = waveform * b->length + from; i <= waveform * b->length + to; i++)
        if (count_at(b, i) >= level && !(b->missing && b->missing[i])) return 1;
    return 0;
}

/* Sets flags of echoes that need no fit; waveforms have one level each. */
static void set_flags(const Table *t, const Block *b, const Flagging *f) {
    const int64_t s = b->length;
    const double level = b->bytes ? f->level : (float)f->level;
    for (int64_t i = 0; i < t->m; i++) {
        const int64_t waveform = t->waveform[i];
        const double time = t->time[i], rest = f->last - time;
        const float amplitude = t->amplitude[i], sigma = t->sigma[i], error = isnan(t->sigma_err[i]) ? 0 : t->sigma_err[i];
        const float reach = (float)f->reach * sigma;
        int set = (amplitude < 5 * b->std[waveform] ? FLAG_WEAK : 0) | ((time < rest ? time : rest) < sigma ? FLAG_NEAR_EDGE : 0);
        if (sigma + 3 * error < (float)f->sigma_ref && sigma < (float)f->narrow) set |= FLAG_NARROW;
        const double low = ceil(at_most(at_least((time - reach) / f->spacing, 0), s)), high = floor(at_most(at_least((time + reach) / f->spacing, -1), s - 1));
        if (is_clipped(b, waveform, (int64_t)low, (int64_t)high, level))
            set |= FLAG_SATURATED | ((float)f->unreliable * amplitude > (float)f->level - b->baseline[waveform] ? FLAG_UNRELIABLE : 0);
        t->flags[i] |= set;
    }
}

/* First rows of pairs of neighbours of a waveform that are one: closer than `width` of the narrower one, and, with
   `error` above 0, than so many errors of their distance. Two echoes of one fit, or without `error` of different fits.
   Returns the number of pairs; with `error` no row is in two. */
static int64_t find_pairs(const Table *t, double width, double error, int64_t *first) {
    int64_t found = 0, free_from = 0;
    for (int64_t i = 0; i + 1 < t->m; i++) {
        if (t->waveform[i] != t->waveform[i + 1] || i < free_from) continue;
        const double gap = t->time[i + 1] - t->time[i], a = t->time_err[i + 1], b = t->time_err[i];
        const float narrower = t->sigma[i + 1] < t->sigma[i] ? t->sigma[i + 1] : t->sigma[i];
        const int together = (t->flags[i] & t->flags[i + 1] & FLAG_OVERLAPPED) != 0;
        if (!(gap < (float)width * narrower) || together != (error > 0)) continue;
        if (error > 0 && !(gap < (float)error * (float)sqrt(a * a + b * b))) continue;
        first[found++] = i;
        if (error > 0) free_from = i + 2;
    }
    return found;
}
