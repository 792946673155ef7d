/* Grey frame to outline: level and noise of the sky, threshold, borders, which of them are the
 * target, and the sub-pixel edge along them.
 *
 * The operations and their order are those of rendezview's own runtime, so that the outlines are
 * the same: keep them when the code is edited. */
#include <math.h>
#include <stddef.h>

#include "rendezview_flight.h"

#define MANY_WINDOWS 1000u  /* along two borders: windows side by side are enough */
#define LEAST_BORDER 0.02   /* of the longest: a border shorter than a quarter of it is noise */
#define LEAST_PART_PX 3.0   /* area of a blob that is joined to another */
#define BRIGHT_SKY 127.0
#define WHITE 255.0

/* Marks of the work memory; Suzuki and Abe's borders with those of holes left out. */
#define SKY 0u
#define TARGET 1u
#define LEFT_EDGE 2u  /* on a border that was followed; the blob goes on to the right ... */
#define RIGHT_EDGE 3u /* ... or ends here */

/* Neighbours of a pixel, clockwise on the screen from East. */
static const int32_t step_x[8] = {1, 1, 0, -1, -1, -1, 0, 1};
static const int32_t step_y[8] = {0, 1, 1, 1, 0, -1, -1, -1};

const rdv_silhouette_options rdv_default_silhouette = {5.0, 4.0, 60.0, 0.0005, 0.15, 0.3, 2u};

typedef struct
{
    const uint8_t *grey;
    uint8_t *work; /* a frame of sky one pixel wide around it */
    int32_t width;
    int32_t height;
} frame_t;

typedef struct
{
    int32_t x; /* uppermost row, its leftmost pixel */
    int32_t y;
    uint32_t length; /* pixels of the border */
    rdv_f64 area;    /* pixels inside and on the border, holes filled */
    int32_t left, top, right, bottom;
    uint8_t large;  /* 1: may be the target */
    uint8_t chosen; /* 1: is of the target */
} blob_t;

/* One pixel of a border with the directions of the pixels before and after it. */
typedef struct
{
    int32_t x;
    int32_t y;
    uint32_t back;
    uint32_t ahead;
    int32_t last_x; /* the pixel before the first one, where the border closes */
    int32_t last_y;
    uint8_t single; /* 1: a blob of one pixel */
} walker_t;

static uint8_t *mark_at(const frame_t *frame, int32_t x, int32_t y)
{
    return &frame->work[((uint32_t)(y + 1) * ((uint32_t)frame->width + 2u)) + (uint32_t)(x + 1)];
}

static int32_t grey_at(const frame_t *frame, int32_t x, int32_t y)
{
    return (int32_t)frame->grey[((uint32_t)y * (uint32_t)frame->width) + (uint32_t)x];
}

static int32_t within(int32_t value, int32_t least, int32_t most)
{
    int32_t result = value;

    if (value < least)
    {
        result = least;
    }
    if (value > most)
    {
        result = most;
    }
    return result;
}

/* ---- The sky ---- */

static uint32_t mean_of_window(const frame_t *frame, int32_t top, int32_t left)
{
    int32_t total = 4; /* rounds */
    int32_t x;
    int32_t y;

    for (y = top; y < (top + 3); y++)
    {
        for (x = left; x < (left + 3); x++)
        {
            total += grey_at(frame, x, y);
        }
    }
    return (uint32_t)total / 9u;
}

/* Grey level below which a share of the counts lies, within its bin by proportion. */
static rdv_f64 quantile(const uint32_t counts[256], uint32_t total, rdv_f64 share)
{
    const rdv_f64 wanted = share * (rdv_f64)total;
    uint32_t seen = 0u;
    uint32_t grey = 0u;

    while ((grey < 255u) && ((rdv_f64)(seen + counts[grey]) <= wanted))
    {
        seen += counts[grey];
        grey++;
    }
    return ((rdv_f64)grey - 0.5) + ((wanted - (rdv_f64)seen) / (rdv_f64)counts[grey]);
}

/* Median and spread of 3 x 3 means along the border, where only sky should be. */
static void look_at_sky(const frame_t *frame, rdv_f64 *level, rdv_f64 *noise)
{
    uint32_t counts[256];
    uint32_t total = 0u;
    const int32_t step = ((uint32_t)(frame->width + frame->height) > MANY_WINDOWS) ? 3 : 1;
    rdv_f64 below;
    int32_t k;

    for (k = 0; k < 256; k++)
    {
        counts[k] = 0u;
    }
    for (k = 0; k <= (frame->width - 3); k += step)
    {
        counts[mean_of_window(frame, 0, k)]++;
        counts[mean_of_window(frame, frame->height - 3, k)]++;
        total += 2u;
    }
    for (k = 0; k <= (frame->height - 3); k += step)
    {
        counts[mean_of_window(frame, k, 0)]++;
        counts[mean_of_window(frame, k, frame->width - 3)]++;
        total += 2u;
    }
    *level = quantile(counts, total, 0.5);
    /* 15.87 %: one sigma below the median of Gaussian noise */
    below = quantile(counts, total, 0.1587);
    *noise = *level - below;
    if (below <= 0.5)
    {
        /* a black sky, its noise cut off at 0: half a sigma above the median, at 69.15 % */
        const rdv_f64 above = 2.0 * (quantile(counts, total, 0.6915) - *level);

        *noise = (above > *noise) ? above : *noise;
    }
}

/* Marks what is brighter than a level in the mean over 3 x 3 pixels. */
static void mark_target(const frame_t *frame, rdv_f64 level)
{
    const int32_t limit = (int32_t)floor(level * 9.0);
    int32_t x;
    int32_t y;

    for (y = -1; y <= frame->height; y++)
    {
        const int32_t above = within(y - 1, 0, frame->height - 1);
        const int32_t here = within(y, 0, frame->height - 1);
        const int32_t below = within(y + 1, 0, frame->height - 1);
        int32_t before = grey_at(frame, 0, above) + grey_at(frame, 0, here) +
                         grey_at(frame, 0, below); /* outermost pixels are repeated */
        int32_t middle = before;

        *mark_at(frame, -1, y) = SKY;
        *mark_at(frame, frame->width, y) = SKY;
        for (x = 0; x < frame->width; x++)
        {
            const int32_t next = within(x + 1, 0, frame->width - 1);
            const int32_t after = grey_at(frame, next, above) + grey_at(frame, next, here) +
                                  grey_at(frame, next, below);
            const int32_t total = before + middle + after;

            *mark_at(frame, x, y) =
                ((y >= 0) && (y < frame->height) && (total > limit)) ? TARGET : SKY;
            before = middle;
            middle = after;
        }
    }
}

/* ---- Borders ---- */

/* Puts a walker on the first pixel of a border; `back` is where the border comes from. */
static void start_walk(const frame_t *frame, int32_t x, int32_t y, walker_t *walker)
{
    uint32_t turn = 1u;
    uint8_t found = 0u;

    walker->x = x;
    walker->y = y;
    /* clockwise from North-West: West is sky */
    while ((turn < 8u) && (found == 0u))
    {
        walker->back = (4u + turn) & 7u;
        found = (*mark_at(frame, x + step_x[walker->back], y + step_y[walker->back]) != SKY) ? 1u
                                                                                            : 0u;
        turn++;
    }
    walker->single = (found == 0u) ? 1u : 0u;
    walker->last_x = x + step_x[walker->back];
    walker->last_y = y + step_y[walker->back];
    walker->ahead = walker->back;
}

/* Finds the direction of the next pixel: counter-clockwise from where the border came from. */
static void look_ahead(const frame_t *frame, walker_t *walker)
{
    uint32_t turn = 1u;
    uint8_t found = 0u;

    while ((turn <= 8u) && (found == 0u))
    {
        walker->ahead = (walker->back + 8u - turn) & 7u;
        found = (*mark_at(frame, walker->x + step_x[walker->ahead],
                          walker->y + step_y[walker->ahead]) != SKY)
                    ? 1u
                    : 0u;
        turn++;
    }
}

/* Goes on to the next pixel; 0 where the border is closed. */
static uint8_t go_on(const blob_t *blob, walker_t *walker)
{
    const int32_t x = walker->x;
    const int32_t y = walker->y;
    uint8_t more = 1u;

    walker->x += step_x[walker->ahead];
    walker->y += step_y[walker->ahead];
    walker->back = (walker->ahead + 4u) & 7u;
    if ((walker->x == blob->x) && (walker->y == blob->y) && (x == walker->last_x) &&
        (y == walker->last_y))
    {
        more = 0u;
    }
    return more;
}

/* Follows a border, marks it, and measures the blob. */
static void measure(const frame_t *frame, blob_t *blob)
{
    walker_t walker;
    int64_t twice = 0;
    uint8_t more = 1u;

    blob->large = 0u;
    blob->chosen = 0u;
    blob->length = 0u;
    blob->left = blob->x;
    blob->right = blob->x;
    blob->top = blob->y;
    blob->bottom = blob->y;
    start_walk(frame, blob->x, blob->y, &walker);
    if (walker.single == 1u)
    {
        *mark_at(frame, blob->x, blob->y) = RIGHT_EDGE;
        blob->length = 1u;
        more = 0u;
    }
    while (more == 1u)
    {
        uint8_t *const mark = mark_at(frame, walker.x, walker.y);
        const int32_t x = walker.x;
        const int32_t y = walker.y;
        uint32_t from_east;
        uint32_t last;

        look_ahead(frame, &walker);
        /* East was looked at and is sky: the blob ends here */
        from_east = (8u - walker.ahead) & 7u;
        last = (8u - walker.back) & 7u;
        if ((from_east > 0u) && ((from_east - 1u) < last))
        {
            *mark = RIGHT_EDGE;
        }
        else if (*mark == TARGET)
        {
            *mark = LEFT_EDGE;
        }
        else
        {
            /* marked before */
        }
        blob->left = (x < blob->left) ? x : blob->left;
        blob->right = (x > blob->right) ? x : blob->right;
        blob->top = (y < blob->top) ? y : blob->top;
        blob->bottom = (y > blob->bottom) ? y : blob->bottom;
        blob->length++;
        more = go_on(blob, &walker);
        twice += ((int64_t)x * (int64_t)walker.y) - ((int64_t)walker.x * (int64_t)y);
    }
    /* Pick's theorem: pixels inside a lattice polygon and on it */
    blob->area = ((fabs((rdv_f64)twice) * 0.5) + (0.5 * (rdv_f64)blob->length)) + 1.0;
}

/* Keeps a blob, where there is no room instead of the one with the shortest border. Blobs stay in
 * their order. `dropped` is the longest border of those left out that are more than a speck. */
static void keep(const blob_t *blob, blob_t blobs[RDV_MOST_BLOBS], uint32_t *count,
                 uint32_t *dropped)
{
    blob_t out = *blob;

    if (*count == RDV_MOST_BLOBS)
    {
        uint32_t shortest = 0u;
        uint32_t k;

        for (k = 1u; k < RDV_MOST_BLOBS; k++)
        {
            shortest = (blobs[k].length < blobs[shortest].length) ? k : shortest;
        }
        if (blob->length > blobs[shortest].length)
        {
            out = blobs[shortest];
            for (k = shortest; (k + 1u) < RDV_MOST_BLOBS; k++)
            {
                blobs[k] = blobs[k + 1u];
            }
            *count -= 1u;
        }
        if ((out.area >= LEAST_PART_PX) && (out.length > *dropped))
        {
            *dropped = out.length;
        }
    }
    if (*count < RDV_MOST_BLOBS)
    {
        blobs[*count] = *blob;
        *count += 1u;
    }
}

/* Outer borders of all that is marked, row by row, the longest; 0 where there are more that
 * may belong to the target. */
static uint8_t find_blobs(const frame_t *frame, blob_t blobs[RDV_MOST_BLOBS], uint32_t *count)
{
    uint32_t longest = 0u;
    uint32_t dropped = 0u;
    int32_t x;
    int32_t y;

    *count = 0u;
    for (y = 0; y < frame->height; y++)
    {
        uint8_t before = SKY;
        uint8_t inside = 0u; /* right of a left edge: in a blob or in a hole of it */

        for (x = 0; x < frame->width; x++)
        {
            uint8_t mark = *mark_at(frame, x, y);

            if ((before == SKY) && (mark == TARGET) && (inside == 0u))
            {
                blob_t blob;

                blob.x = x;
                blob.y = y;
                measure(frame, &blob);
                longest = (blob.length > longest) ? blob.length : longest;
                keep(&blob, blobs, count, &dropped);
                mark = *mark_at(frame, x, y);
            }
            if (mark > TARGET)
            {
                inside = (mark == LEFT_EDGE) ? 1u : 0u;
            }
            before = mark;
        }
    }
    return ((dropped == 0u) || ((rdv_f64)(4u * dropped) < (LEAST_BORDER * (rdv_f64)longest))) ? 1u
                                                                                             : 0u;
}

/* ---- Which blobs are the target ---- */

static rdv_f64 outside(rdv_f64 value, int32_t least, int32_t most)
{
    return fmax(fmax((rdv_f64)least - value, value - (rdv_f64)most), 0.0);
}

static rdv_f64 distance_to(const rdv_point *point, const blob_t *blob)
{
    /* of two boxes around the point, the one centred on it */
    const rdv_f64 off = hypot((0.5 * (rdv_f64)(blob->left + blob->right)) - point->x,
                              (0.5 * (rdv_f64)(blob->top + blob->bottom)) - point->y);

    return hypot(outside(point->x, blob->left, blob->right),
                 outside(point->y, blob->top, blob->bottom)) +
           (1e-3 * off);
}

static rdv_f64 gap(const rdv_silhouette_found *a, const blob_t *b)
{
    const int32_t dx = within((a->left > b->right) ? (a->left - b->right) : (b->left - a->right), 0,
                              (int32_t)RDV_MOST_SIDE);
    const int32_t dy = within((a->top > b->bottom) ? (a->top - b->bottom) : (b->top - a->bottom), 0,
                              (int32_t)RDV_MOST_SIDE);

    return hypot((rdv_f64)dx, (rdv_f64)dy);
}

/* The largest blob, or of the bodies the one nearest to a place. Also which blobs are large. */
static uint32_t main_blob(blob_t blobs[RDV_MOST_BLOBS], uint32_t count,
                          const rdv_silhouette_options *options, const rdv_point *expected,
                          rdv_f64 *least_body)
{
    uint32_t longest = 0u;
    uint32_t largest = 0u;
    uint32_t result;
    uint32_t k;

    for (k = 0u; k < count; k++)
    {
        longest = (blobs[k].length > longest) ? blobs[k].length : longest;
    }
    for (k = 0u; k < count; k++)
    {
        blobs[k].chosen = 0u;
        blobs[k].large =
            ((rdv_f64)(4u * blobs[k].length) >= (LEAST_BORDER * (rdv_f64)longest)) ? 1u : 0u;
        if ((blobs[largest].large == 0u) ||
            ((blobs[k].large == 1u) && (blobs[k].area >= blobs[largest].area)))
        {
            largest = k;
        }
    }
    *least_body = options->rival_fraction * blobs[largest].area;
    result = largest;
    if (expected != NULL)
    {
        rdv_f64 nearest = HUGE_VAL;

        for (k = 0u; k < count; k++)
        {
            if ((blobs[k].large == 1u) && (blobs[k].area >= *least_body))
            {
                const rdv_f64 distance = distance_to(expected, &blobs[k]);

                if (distance <= nearest)
                {
                    nearest = distance;
                    result = k;
                }
            }
        }
    }
    return result;
}

/* Joins what lies within reach of the target so far, until nothing is left. The order of the
 * outlines, from below, is the runtime's. */
static void join(blob_t blobs[RDV_MOST_BLOBS], uint32_t count,
                 const rdv_silhouette_options *options, const blob_t *body, uint32_t *order,
                 rdv_silhouette_found *found)
{
    const int32_t width = body->right - body->left;
    const int32_t height = body->bottom - body->top;
    const rdv_f64 reach = options->merge_gap * (rdv_f64)((width > height) ? width : height);
    const rdv_f64 least = fmax(LEAST_PART_PX, options->speck_fraction * body->area);
    uint32_t before = 0u;

    while (before < found->outlines)
    {
        uint32_t k;

        before = found->outlines;
        for (k = count; k > 0u; k--)
        {
            const blob_t *const blob = &blobs[k - 1u];

            if ((blob->large == 1u) && (blob->chosen == 0u) && (blob->area >= least) &&
                (gap(found, blob) <= reach))
            {
                order[found->outlines] = k - 1u;
                found->outlines++;
            }
        }
        for (k = before; k < found->outlines; k++)
        {
            blob_t *const blob = &blobs[order[k]];

            blob->chosen = 1u;
            found->area_px += blob->area;
            found->left = (blob->left < found->left) ? blob->left : found->left;
            found->right = (blob->right > found->right) ? blob->right : found->right;
            found->top = (blob->top < found->top) ? blob->top : found->top;
            found->bottom = (blob->bottom > found->bottom) ? blob->bottom : found->bottom;
        }
    }
}

static rdv_status choose(const frame_t *frame, blob_t blobs[RDV_MOST_BLOBS], uint32_t count,
                         const rdv_silhouette_options *options, const rdv_point *expected,
                         uint32_t *order, rdv_silhouette_found *found)
{
    rdv_status status = RDV_OK;
    rdv_f64 least_body = 0.0;
    const uint32_t main_place = main_blob(blobs, count, options, expected, &least_body);
    blob_t *const body = &blobs[main_place];
    uint32_t rivals = 0u;
    uint32_t k;

    body->chosen = 1u;
    order[0] = main_place;
    found->outlines = 1u;
    found->area_px = body->area;
    found->left = body->left;
    found->right = body->right;
    found->top = body->top;
    found->bottom = body->bottom;
    join(blobs, count, options, body, order, found);
    for (k = 0u; k < count; k++)
    {
        if ((blobs[k].large == 1u) && (blobs[k].chosen == 0u) && (blobs[k].area >= least_body))
        {
            rivals++;
        }
    }
    if (body->area < options->least_area_px)
    {
        status = RDV_SMALL;
    }
    else if ((rivals > 0u) && (expected == NULL))
    {
        status = RDV_RIVALS;
    }
    else if ((found->left <= 0) || (found->top <= 0) || (found->right >= (frame->width - 1)) ||
             (found->bottom >= (frame->height - 1)))
    {
        const rdv_f64 whole = (rdv_f64)frame->width * (rdv_f64)frame->height;
        const rdv_f64 box = (rdv_f64)((found->right - found->left) + 1) *
                            (rdv_f64)((found->bottom - found->top) + 1);

        status = ((box > (0.95 * whole)) && (found->area_px > (0.9 * whole))) ? RDV_FULL
                                                                              : RDV_BORDER;
    }
    else
    {
        /* the target, whole */
    }
    return status;
}

/* ---- The edge between border pixels and their outer neighbours ---- */

static uint8_t in_frame(const frame_t *frame, int32_t x, int32_t y)
{
    return ((x >= 0) && (x < frame->width) && (y >= 0) && (y < frame->height)) ? 1u : 0u;
}

/* Distance from a border pixel outwards to the middle grey level of the edge; 0: there is none. */
static uint8_t edge_shift(const frame_t *frame, const walker_t *at, uint32_t direction,
                          const rdv_silhouette_found *found, uint32_t reach, rdv_f64 *shift)
{
    const int32_t dx = step_x[direction];
    const int32_t dy = step_y[direction];
    const int32_t here = grey_at(frame, at->x, at->y);
    int32_t best = here;
    int32_t step;
    uint8_t is_edge = 0u;

    for (step = 1; step <= (int32_t)reach; step++)
    {
        const int32_t x = at->x - (step * dx);
        const int32_t y = at->y - (step * dy);

        if ((in_frame(frame, x, y) == 1u) && (grey_at(frame, x, y) > best))
        {
            best = grey_at(frame, x, y);
        }
    }
    if ((rdv_f64)best >= (found->sky_grey + (found->level_grey - found->sky_grey)))
    {
        const rdv_f64 level = 0.5 * (found->sky_grey + (rdv_f64)best);
        rdv_f64 inner = (rdv_f64)here;

        if (in_frame(frame, at->x + dx, at->y + dy) == 0u)
        {
            *shift = 0.5;
            is_edge = 1u;
        }
        else
        {
            rdv_f64 outer = (rdv_f64)grey_at(frame, at->x + dx, at->y + dy);
            uint8_t more = 1u;

            step = 0;
            while (more == 1u)
            {
                if (inner >= level)
                {
                    *shift = (outer >= level)
                                 ? ((rdv_f64)(-step) + 0.99)
                                 : ((rdv_f64)(-step) + ((inner - level) / (inner - outer)));
                    is_edge = 1u;
                    more = 0u;
                }
                else
                {
                    const int32_t x = at->x - ((step + 1) * dx);
                    const int32_t y = at->y - ((step + 1) * dy);

                    step++;
                    if ((step > (int32_t)reach) || (in_frame(frame, x, y) == 0u))
                    {
                        more = 0u;
                    }
                    else
                    {
                        outer = inner;
                        inner = (rdv_f64)grey_at(frame, x, y);
                    }
                }
            }
        }
    }
    return is_edge;
}

/* Points of one blob's outline: each side of a border pixel that faces outside gives one. */
static uint8_t trace(const frame_t *frame, const blob_t *blob, uint32_t reach, rdv_point *points,
                     uint32_t most_points, uint32_t *count, const rdv_silhouette_found *found)
{
    walker_t walker;
    uint8_t more = 1u;
    uint8_t room = 1u;

    start_walk(frame, blob->x, blob->y, &walker);
    while ((more == 1u) && (room == 1u))
    {
        uint32_t first = 6u; /* of a single pixel */
        uint32_t sides = 8u;
        uint32_t k;

        if (walker.single == 0u)
        {
            look_ahead(frame, &walker);
            first = (walker.back + 7u) & 7u;
            sides = (walker.back != walker.ahead) ? ((first + 8u - walker.ahead) & 7u) : 7u;
        }
        for (k = first & 1u; k < sides; k += 2u) /* corners give no point */
        {
            const uint32_t direction = (first + 8u - k) & 7u;
            rdv_f64 shift = 0.0;

            if (edge_shift(frame, &walker, direction, found, reach, &shift) == 1u)
            {
                if (*count < most_points)
                {
                    points[*count].x = (rdv_f64)walker.x + (shift * (rdv_f64)step_x[direction]);
                    points[*count].y = (rdv_f64)walker.y + (shift * (rdv_f64)step_y[direction]);
                    *count += 1u;
                }
                else
                {
                    room = 0u;
                }
            }
        }
        more = (walker.single == 1u) ? 0u : go_on(blob, &walker);
    }
    return room;
}

static rdv_status find(const frame_t *frame, const rdv_silhouette_options *options,
                       const rdv_point *expected, rdv_point *points, uint32_t most_points,
                       rdv_silhouette_found *found)
{
    rdv_status status = RDV_OK;
    blob_t blobs[RDV_MOST_BLOBS];
    uint32_t order[RDV_MOST_BLOBS];
    uint32_t count = 0u;

    mark_target(frame, found->level_grey);
    if (find_blobs(frame, blobs, &count) == 0u)
    {
        status = RDV_NO_ROOM;
    }
    else if (count == 0u)
    {
        status = (found->sky_grey > BRIGHT_SKY) ? RDV_FULL : RDV_EMPTY;
    }
    else
    {
        status = choose(frame, blobs, count, options, expected, order, found);
    }
    if (status == RDV_OK)
    {
        uint32_t used = 0u;
        uint32_t k;

        for (k = 0u; k < found->outlines; k++)
        {
            if (trace(frame, &blobs[order[k]], options->reach_px, points, most_points, &used,
                      found) == 0u)
            {
                status = RDV_NO_ROOM;
            }
            found->ends[k] = used;
        }
    }
    return status;
}

rdv_status rdv_silhouette(const uint8_t *grey, uint32_t width, uint32_t height,
                          const rdv_silhouette_options *options, const rdv_point *expected_px,
                          uint8_t *work, rdv_point *points, uint32_t most_points,
                          rdv_silhouette_found *found)
{
    rdv_status status = RDV_BAD_INPUT;

    if ((grey != NULL) && (options != NULL) && (work != NULL) && (points != NULL) &&
        (found != NULL) && (width >= RDV_LEAST_SIDE) && (width <= RDV_MOST_SIDE) &&
        (height >= RDV_LEAST_SIDE) && (height <= RDV_MOST_SIDE) &&
        (options->reach_px <= RDV_LEAST_SIDE))
    {
        const frame_t frame = {grey, work, (int32_t)width, (int32_t)height};
        rdv_f64 noise = 0.0;

        found->outlines = 0u;
        look_at_sky(&frame, &found->sky_grey, &noise);
        found->level_grey = found->sky_grey + fmax(options->noise_sigmas * noise,
                                                   options->least_contrast_grey);
        status = (found->level_grey >= WHITE)
                     ? RDV_FULL
                     : find(&frame, options, expected_px, points, most_points, found);
    }
    return status;
}
