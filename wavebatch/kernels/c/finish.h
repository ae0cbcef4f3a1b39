/* From echoes of fits to the table that a decomposer gives: echoes inside of gaps and twins go, unresolved ones become one,
   those that errors of a stronger one explain go, errors cover what fits leave unexplained, and flags are set.

   stages/flags.py and stages/decompose/merge.py have the reasons. All steps work in place: an echo passes a dozen of them,
   and a survey finishes a hundred small tables. */

enum { FLAG_RINGING = 64, FLAG_MERGED = 4096 };

typedef struct { /* steps in this order; what is 0 or NULL is left out */
    int64_t sort;                              /* by waveform, then time: as fits give them, few are out of order */
    double gaps;                               /* time between two samples: echoes inside of gaps are left out */
    double twins;                              /* widths below which two separate fits are one echo */
    double overlap, unresolved;                /* widths, and errors of their distance, below which two of one fit are one */
    const Faintness *unproven;
    const Unexplained *unexplained;
    int64_t others, lone;                      /* what others leave counts too; OVERLAPPED goes where no other echo has it */
    const Flagging *flagging;
    const Faintness *ringing;
    const double *factors;                     /* on the errors of each fitted echo, four each, for `grown` */
} Finishing;

typedef struct { int32_t waveform; double time; float floats[7]; uint16_t flags; int64_t row; } OneEcho;

static OneEcho get_echo(const Table *e, int64_t i) {
    return (OneEcho){e->waveform[i], e->time[i], {e->amplitude[i], e->sigma[i], e->time_err[i], e->amplitude_err[i], e->sigma_err[i],
        e->relative_energy_err[i], e->residual[i]}, e->flags[i], e->row[i]};
}

static void put_echo(const Table *e, int64_t i, OneEcho one) {
    float *const columns[] = {e->amplitude, e->sigma, e->time_err, e->amplitude_err, e->sigma_err, e->relative_energy_err, e->residual};
    e->waveform[i] = one.waveform;
    e->time[i] = one.time;
    for (int k = 0; k < 7; k++) columns[k][i] = one.floats[k];
    e->flags[i] = one.flags;
    e->row[i] = one.row;
}

/* Each echo moves before those that it precedes: echoes of one place keep their order. */
static void sort_echoes(const Table *e) {
    for (int64_t i = 1; i < e->m; i++) {
        int64_t to = i;
        while (to && (e->waveform[to - 1] > e->waveform[i] || (e->waveform[to - 1] == e->waveform[i] && e->time[to - 1] > e->time[i]))) to--;
        if (to == i) continue;
        const OneEcho one = get_echo(e, i);
        for (int64_t k = i; k > to; k--) put_echo(e, k, get_echo(e, k - 1));
        put_echo(e, to, one);
    }
}

/* Keeps the echoes that are not marked, in their order. */
static void leave_out(Table *e, const uint8_t *marked) {
    const uint8_t *const first = memchr(marked, 1, e->m);
    int64_t kept = first ? first - marked : e->m;
    for (int64_t i = kept; i < e->m; i++)
        if (!marked[i]) put_echo(e, kept++, get_echo(e, i));
    e->m = kept;
}

/* How far a time [samples] lies from the nearest gap of its waveform: negative inside of it, infinite without one. */
static double gap_distance(const Block *b, int64_t waveform, double time) {
    const uint8_t *missing = b->missing + waveform * b->length;
    const int64_t s = b->length, here = (int64_t)floor(fmin(fmax(time, -1), s));
    int64_t end = (here < s ? here : s - 1) + 1, next = end;
    double away = INFINITY;
    if (end > 0 && missing[end - 1]) while (end < s && missing[end]) end++; /* it lies in a gap, up to its end */
    else while (end > 0 && !missing[end - 1]) end--;                        /* or after one, or after none */
    if (end > 0) {
        int64_t start = end;
        while (start > 0 && missing[start - 1]) start--;
        away = fmax(start - 1 - time, time - end);
        if (end > next) next = end;
    }
    while (next < s && !missing[next]) next++;
    return next < s ? fmin(away, next - 1 - time) : away;
}

static float lesser(float a, float b) { return isnan(a) || a < b ? a : b; }

/* Two echoes as one in the place of the first: with their area, mean time and variance, and the better errors. */
static void merge_pair(const Table *e, int64_t i) {
    const int64_t j = i + 1;
    const double a = (double)e->amplitude[i] * e->sigma[i], b = (double)e->amplitude[j] * e->sigma[j];
    const double total = a + b < 1e-12 ? 1e-12 : a + b, share = a / total;
    const double time = share * e->time[i] + (1 - share) * e->time[j], early = e->time[i] - time, late = e->time[j] - time;
    const float square_a = e->sigma[i] * e->sigma[i], square_b = e->sigma[j] * e->sigma[j];
    const double sigma = sqrt(share * (square_a + early * early) + (1 - share) * (square_b + late * late));
    const float relative = lesser(e->amplitude_err[i] / e->amplitude[i], e->amplitude_err[j] / e->amplitude[j]);
    e->time[i] = time;
    e->amplitude[i] = (float)(total / sigma);
    e->sigma[i] = (float)sigma;
    e->time_err[i] = lesser(e->time_err[i], e->time_err[j]);
    e->amplitude_err[i] = (float)(relative * total / sigma);
    e->sigma_err[i] = lesser(e->sigma_err[i], e->sigma_err[j]);
    e->relative_energy_err[i] = lesser(e->relative_energy_err[i], e->relative_energy_err[j]);
    e->flags[i] |= e->flags[j] | FLAG_MERGED;
}

/* Clears OVERLAPPED of echoes without another one that has it in their waveform: the partners of their fit are gone. */
static void clear_lone(const Table *e) {
    for (int64_t i = 0, end; i < e->m; i = end) {
        int64_t number = 0, last = 0;
        end = end_of_waveform(e, i);
        for (int64_t j = i; j < end; j++)
            if (e->flags[j] & FLAG_OVERLAPPED) number++, last = j;
        if (number == 1 && !(e->flags[last] & FLAG_MERGED)) e->flags[last] &= ~FLAG_OVERLAPPED;
    }
}

/* Echoes that are sorted, or to be sorted, by waveform, then time. `grown`, or NULL: factors on the errors of amplitudes, up to
   1, by how much they grew here. */
EXPORT int64_t finish_echoes(Table *e, const Block *b, const Finishing *f, float *grown) {
    double *room = malloc((2 * e->m + 1) * sizeof *room), *variance = room + e->m;
    uint8_t *marked = (uint8_t *)room;
    int64_t *pair = (int64_t *)variance;
    if (!room) return -1;
    if (f->sort) sort_echoes(e);
    if (f->gaps > 0 && b->missing) {           /* an echo between two recorded samples is known, however narrow it is */
        for (int64_t i = 0; i < e->m; i++) {
            const float half = 0.5f * e->sigma[i] / (float)f->gaps;
            marked[i] = gap_distance(b, e->waveform[i], e->time[i] / f->gaps) < -(half > 1 ? half : 1);
        }
        leave_out(e, marked);
    }
    for (int merging = 0; merging < 2; merging++) {
        const double width = merging ? f->overlap : f->twins;
        for (int64_t found = e->m; found && width > 0; leave_out(e, marked)) {
            found = find_pairs(e, width, merging ? f->unresolved : 0, pair);
            memset(marked, 0, e->m);
            for (int64_t k = 0; k < found; k++) {
                const int64_t i = pair[k];
                if (merging) merge_pair(e, i);
                marked[merging || !(e->amplitude[i] < e->amplitude[i + 1]) ? i + 1 : i] = 1;
            }
            if (!merging) found = 0;           /* of twins once, merged echoes may be close to others again */
        }
    }
    if (f->unproven) {
        find_faint(e, f->unproven, marked);
        leave_out(e, marked);
    }
    if (f->unexplained) {
        memset(variance, 0, e->m * sizeof *variance);
        weigh_fits(e, f->unexplained, room, f->others ? variance : NULL);
        for (int64_t i = 0; i < e->m; i++) {
            const float factor = (float)sqrt(room[i] * (1 + variance[i])), before = e->amplitude_err[i];
            float *const errors[] = {e->time_err, e->amplitude_err, e->sigma_err, e->relative_energy_err};
            for (int k = 0; k < 4; k++) errors[k][i] *= factor;
            if (!grown) continue;
            const double colour = f->factors[4 * e->row[i]];
            grown[i] = (float)(colour > 1 ? 1 : colour) * e->amplitude_err[i] / before;
        }
    }
    if (f->lone) clear_lone(e);
    if (f->flagging) {
        const double spacing = f->flagging->spacing;
        set_flags(e, b, f->flagging);
        for (int64_t i = 0; i < e->m && b->missing; i++)
            if (gap_distance(b, e->waveform[i], e->time[i] / spacing) * spacing < e->sigma[i]) e->flags[i] |= FLAG_NEAR_EDGE;
    }
    if (f->ringing) {
        find_faint(e, f->ringing, marked);
        for (int64_t i = 0; i < e->m; i++)
            if (marked[i] && e->amplitude[i] > 0) e->flags[i] |= FLAG_RINGING;
    }
    free(room);
    return 0;
}
