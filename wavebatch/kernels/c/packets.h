/* Which packets of points can be used: files/strip/packet_check.py has the reasons, in the same order. */

enum {
    REASON_USABLE, REASON_NO_WAVEFORM, REASON_NO_DESCRIPTOR, REASON_BAD_DESCRIPTOR, REASON_EMPTY, REASON_OUTSIDE,
    REASON_NO_GEOMETRY, REASON_PACKED = 8, REASON_CUT = 10
};

typedef struct { /* fields of n records, `stride` bytes from one to the next */
    int64_t n, stride;
    const uint8_t *index, *offset, *size, *location, *x, *y, *z;
} Points;

typedef struct { /* what descriptors allow, 256 each; the waveform data reach from `least` to before `end` */
    const uint8_t *known, *good, *odd, *packs;
    const int64_t *width, *samples, *packed;
    int64_t least, end, is_range;              /* vectors are whole paths */
    double unit, longest, furthest;            /* of vectors; longest vector in that unit, furthest location */
} Rules;

typedef struct {
    uint8_t *reason;
    int32_t *n_samples;
    uint64_t *keys;
    uint8_t *is_short, *packed;
} Judged;

static double read_real(const uint8_t *at) {
    float value;
    memcpy(&value, at, sizeof value);
    return value;
}

static int has_geometry(const Points *p, const Rules *r, int64_t at) {
    double x = read_real(p->x + at), y = read_real(p->y + at), z = read_real(p->z + at), location = fabs(read_real(p->location + at));
    double length = sqrt(x * x + y * y + z * z) * r->unit;
    if (r->is_range) length /= location;
    return length > 0 && length <= r->longest && location <= r->furthest;
}

EXPORT int64_t judge_packets(const Points *p, const Rules *r, const Judged *out) {
    for (int64_t i = 0; i < p->n; i++) {
        int64_t at = i * p->stride;
        uint32_t size;
        uint64_t offset;
        memcpy(&size, p->size + at, sizeof size);
        memcpy(&offset, p->offset + at, sizeof offset);
        const int kind = p->index[at], packs = r->packs[kind];
        const int64_t all = r->samples[kind], width = r->width[kind];
        int64_t samples = size / width < all ? size / width : all;
        /* A compressed packet has all samples of its descriptor, in any number of bytes. */
        if (packs) samples = size > width ? all : 0;
        /* Only the size of the packet shows whether samples of 12 bits have two bytes each. */
        const int packed = size == r->packed[kind] && !packs;
        if (packed) samples = all;
        const int64_t room = r->end - (packed || packs ? size : samples * width);
        uint8_t reason = !kind || !size ? REASON_NO_WAVEFORM
            : !r->known[kind] ? REASON_NO_DESCRIPTOR
            : !r->good[kind] ? REASON_BAD_DESCRIPTOR
            : r->odd[kind] && samples < all ? REASON_PACKED
            : !samples ? REASON_EMPTY
            : offset < (uint64_t)r->least ? REASON_OUTSIDE
            : room < 0 || offset > (uint64_t)room ? REASON_CUT
            : !has_geometry(p, r, at) ? REASON_NO_GEOMETRY : REASON_USABLE;
        out->reason[i] = reason;
        out->n_samples[i] = reason ? 0 : samples;
        out->keys[i] = offset << 8 | kind;
        out->is_short[i] = !reason && samples < all;
        out->packed[i] = packed;
    }
    return 0;
}
