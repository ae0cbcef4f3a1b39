/* Candidates of a matched filter: maxima of waveforms correlated with the system pulse, docs/algorithms.md 1.1 (4). */

/* As `find_maxima`: waveforms `from` to n - 1, until the room ends. Times and heights are those of the correlation, widths
   those of the smoothed waveform. What lies inside of gaps is no candidate, whatever the filter shows there. */
INLINE int64_t find_correlated_any(const Block *b, int64_t n, const Detector *d, int64_t from, Candidates *out, int64_t *found) {
    const int64_t s = b->length;
    const double ref = d->width_ref;
    Rows r = {0};
    int64_t w = reserve_rows(&r, s) ? from : -1, total = 0;
    for (; w >= 0 && w < n; w++) {
        int64_t here = total;
        if (!read_signal(b, w, r.signal)) continue;
        filter_rows(r.signal, 1, s, 1, d->taps, d->reach, r.even);
        mark_peaks(s, r.even, (float)d->threshold * b->std[w], r.marks);
        smooth_121(s, r.signal, r.smoothed);
        for (int64_t i = next_peak(s, r.even, r.marks, 0); i < s && here < out->room; i = next_peak(s, r.even, r.marks, i + 1)) {
            double amplitude, time, width = ref;
            refine_peak(s, r.even, i, &out->amplitude[here], &out->time[here]);
            if (b->missing && !(gap_distance(b, w, out->time[here]) > -1)) continue;
            start_of(s, r.smoothed, i, &amplitude, &time, &width);
            out->waveform[here] = w;
            out->width[here++] = at_most(at_least(width, 0.8 * ref), 2 * ref);
        }
        if (here == out->room) break;
        total = here;
    }
    free_rows(&r);
    *found = total;
    return w;
}
OFFER(find_correlated, (const Block *b, int64_t n, const Detector *d, int64_t from, Candidates *out, int64_t *found), (b, n, d, from, out, found))
