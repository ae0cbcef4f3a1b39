/* Points of one pulse and of one waveform: which they are, return numbers, the nearest return. Points around a place.

   Pairs of echoes and returns of one waveform: mutual nearest neighbours, then again among the rest, until none is left.

   A lone echo beside a lone return, the usual case, needs no search. Groups are short (a pulse has fewer
   than `longest` points, an echo table at most some hundred rows of a waveform), so that work may grow with their square. */

static void sort_by_time(int64_t n, int64_t *rows, const double *time) { /* by insertion: nearly always in order */
    for (int64_t i = 1; i < n; i++) {
        const int64_t row = rows[i];
        int64_t at = i;
        for (; at > 0 && time[rows[at - 1]] > time[row]; at--) rows[at] = rows[at - 1];
        rows[at] = row;
    }
}

/* Place in `others`, which is not empty, of the one nearest to each row; both in order; of two equally near ones the first. */
static void find_near(int64_t n, const int64_t *rows, const double *time, int64_t m, const int64_t *others, const double *other_time, int64_t *near) {
    for (int64_t i = 0, right = 0; i < n; i++) {
        const double here = time[rows[i]];
        while (right < m - 1 && other_time[others[right]] < here) right++;
        const int64_t left = right ? right - 1 : 0;
        near[i] = here - other_time[others[left]] <= other_time[others[right]] - here ? left : right;
    }
}

/* m echoes and k returns, each sorted by waveform; `matched` gets the return of each echo, -1 without one. */
EXPORT int64_t match_returns(int64_t m, const int64_t *echo_waveform, const double *echo_time, int64_t k, const int64_t *return_waveform,
                             const double *return_time, double tolerance, int64_t *matched) {
    int64_t *echoes = malloc((2 * (m + k) + 1) * sizeof(int64_t));
    if (!echoes) return -1;
    int64_t *returns = echoes + m, *to_return = returns + k, *to_echo = to_return + m;
    for (int64_t i = 0, j = 0, end, stop; i < m; i = end, j = stop) {
        const int64_t waveform = echo_waveform[i];
        for (end = i; end < m && echo_waveform[end] == waveform; end++) matched[end] = -1;
        while (j < k && return_waveform[j] < waveform) j++;
        for (stop = j; stop < k && return_waveform[stop] == waveform;) stop++;
        int64_t n = end - i, r = stop - j, pairs = 1;
        if (n == 1 && r == 1) {
            if (fabs(echo_time[i] - return_time[j]) <= tolerance) matched[i] = j;
            continue;
        }
        for (int64_t x = 0; x < n; x++) echoes[x] = i + x;
        for (int64_t x = 0; x < r; x++) returns[x] = j + x;
        sort_by_time(n, echoes, echo_time);
        sort_by_time(r, returns, return_time);
        while (n && r && pairs) {
            find_near(n, echoes, echo_time, r, returns, return_time, to_return);
            find_near(r, returns, return_time, n, echoes, echo_time, to_echo);
            int64_t left = 0;
            pairs = 0;
            for (int64_t x = 0; x < n; x++) {
                const int64_t near = to_return[x], row = returns[near];
                if (to_echo[near] == x && fabs(echo_time[echoes[x]] - return_time[row]) <= tolerance) {
                    matched[echoes[x]] = row;
                    to_echo[near] = -1; /* taken: no other echo can be its nearest */
                    pairs++;
                } else echoes[left++] = echoes[x];
            }
            n = left, left = 0;
            for (int64_t y = 0; y < r; y++) if (to_echo[y] >= 0) returns[left++] = returns[y];
            r = left;
        }
    }
    free(echoes);
    return 0;
}

/* First point of the pulse of each of n points: a run of equal times, but for time 0 and for runs of `longest` and more. */
EXPORT int64_t find_pulses(int64_t n, const double *time, int64_t longest, int64_t *first) {
    for (int64_t i = 0, end; i < n; i = end) {
        for (end = i + 1; end < n && time[end] == time[i];) end++;
        const int is_pulse = end - i < longest && time[i] != 0;
        for (int64_t j = i; j < end; j++) first[j] = is_pulse ? i : j;
    }
    return 0;
}

/* Nearest return of each of m echoes; both sorted by waveform. -1 without one; of two equally near ones the earlier. */
EXPORT int64_t find_nearest(int64_t m, const int64_t *echo_waveform, const double *echo_time, int64_t k, const int64_t *return_waveform,
                            const double *return_time, int64_t *nearest) {
    for (int64_t i = 0, first = 0; i < m; i++) {
        double least = INFINITY;
        nearest[i] = -1;
        while (first < k && return_waveform[first] < echo_waveform[i]) first++;
        for (int64_t j = first; j < k && return_waveform[j] == echo_waveform[i]; j++) {
            const double gap = fabs(return_time[j] - echo_time[i]);
            const int is_nearer = gap < least || (gap == least && return_time[j] <= echo_time[i]);
            if (nearest[i] < 0 || is_nearer) { nearest[i] = j; least = gap; }
        }
    }
    return 0;
}

/* Return number and number of returns of m points, sorted by pulse, by their order along the first ray that is known of
   the pulse; `ordered` where there is one. */
EXPORT int64_t number_returns(int64_t m, const int64_t *pulse, const double *xyz, const double *direction, int64_t *number, int64_t *count,
                              uint8_t *ordered) {
    int64_t *rows = malloc((m + 1) * sizeof *rows);
    double *along = malloc((m + 1) * sizeof *along);
    int64_t done = rows && along ? 0 : -1;
    for (int64_t i = 0, end; i < m && done == 0; i = end) {
        int64_t head = -1;
        for (end = i; end < m && pulse[end] == pulse[i]; end++) {
            const double *ray = direction + 3 * end;
            if (head < 0 && (ray[0] != 0 || ray[1] != 0 || ray[2] != 0)) head = end;
        }
        const double *from = xyz + 3 * (head < 0 ? i : head), *ray = direction + 3 * (head < 0 ? i : head);
        for (int64_t j = i; j < end; j++) {
            const double *to = xyz + 3 * j;
            along[j] = (to[0] - from[0]) * ray[0] + (to[1] - from[1]) * ray[1] + (to[2] - from[2]) * ray[2];
            rows[j] = j;
        }
        sort_by_time(end - i, rows + i, along);
        for (int64_t j = i; j < end; j++) {
            number[rows[j]] = j - i + 1;
            count[j] = end - i;
            ordered[j] = head >= 0;
        }
    }
    free(rows); free(along);
    return done;
}

typedef struct { double *offset, *doubt; uint8_t *known; } Offsets;

/* Offset of m fitted times, sorted by waveform, from the returns at `matched` (-1: none) that a waveform shares, weighted
   by their errors; its error by the scatter of the returns, 0 where their errors explain it; and where it is known. */
EXPORT int64_t share_offsets(int64_t m, const int64_t *waveform, const double *time, const double *error, const int64_t *matched,
                             const double *return_time, Offsets *out) {
    for (int64_t i = 0, end; i < m; i = end) {
        double total = 0, sum = 0, scatter = 0;
        int64_t others = -1;
        for (int pass = 0; pass < 2; pass++) {
            for (end = i; end < m && waveform[end] == waveform[i]; end++) {
                if (matched[end] < 0) continue;
                const double spread = at_least(isfinite(error[end]) ? error[end] : 1, 1e-3), weight = 1 / (spread * spread);
                const double difference = time[end] - return_time[matched[end]], rest = difference - sum;
                if (pass) scatter += weight * (rest * rest);
                else { total += weight; sum += weight * difference; others++; }
            }
            if (others < 0) break;
            if (!pass) sum /= total;
        }
        if (others < 0) continue;
        out->offset[waveform[i]] = sum;
        out->known[waveform[i]] = 1;
        if (others > 0 && scatter > others) out->doubt[waveform[i]] = sqrt(scatter / (others * total));
    }
    return 0;
}

/* Pairs (point, neighbour) whose squared distance is at most `square`, as point * m + neighbour; their number. Neighbours
   (m, 3) are sorted by cells; each of n points looks from `first` to before `last` in nine rows of cells. */
EXPORT int64_t find_around(int64_t n, const double *points, const int64_t *first, const int64_t *last, const double *neighbours,
                           const int64_t *order, int64_t m, double square, int64_t *pairs) {
    int64_t found = 0;
    for (int64_t row = 0; row < 9 * n; row++) {
        const double *at = points + 3 * (row / 9);
        for (int64_t j = first[row]; j < last[row]; j++) {
            const double x = neighbours[3 * j] - at[0], y = neighbours[3 * j + 1] - at[1], z = neighbours[3 * j + 2] - at[2];
            pairs[found] = row / 9 * m + order[j];
            found += x * x + y * y + z * z <= square; /* no branch: about every third is near */
        }
    }
    return found;
}
