/* Shared by sky.c, borders.c and silhouette.c; not for callers. */
#ifndef RENDEZVIEW_FRAME_H
#define RENDEZVIEW_FRAME_H

#include "rendezview_flight.h"

/* Marks of the work memory. */
#define RDV_MARK_SKY 0u
#define RDV_MARK_TARGET 1u
#define RDV_MARK_LEFT 2u  /* on a border that was followed; the blob goes on to the right ... */
#define RDV_MARK_RIGHT 3u /* ... or ends here */

#define RDV_LEAST_PART_PX 3.0 /* area of a blob that is joined to another */
#define RDV_LEAST_BORDER 0.02 /* of the longest: a border shorter than a quarter of it is noise */

/* Neighbours of a pixel, clockwise on the screen from East. */
extern const int32_t rdv_step_x[8];
extern const int32_t rdv_step_y[8];

typedef struct
{
    const uint8_t *grey;
    uint8_t *work; /* a frame of sky one pixel wide around it */
    int32_t width;
    int32_t height;
} rdv_frame;

typedef struct
{
    int32_t x; /* uppermost row, its leftmost pixel */
    int32_t y;
    uint32_t length; /* pixels of the border */
    rdv_f64 area;    /* pixels inside and on the border, holes filled */
    int32_t left, top, right, bottom;
    uint8_t large;  /* 1: may be the target */
    uint8_t chosen; /* 1: is of the target */
} rdv_blob;

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
} rdv_walker;

static inline uint8_t *rdv_mark_at(const rdv_frame *frame, int32_t x, int32_t y)
{
    return &frame->work[((uint32_t)(y + 1) * ((uint32_t)frame->width + 2u)) + (uint32_t)(x + 1)];
}

static inline int32_t rdv_grey_at(const rdv_frame *frame, int32_t x, int32_t y)
{
    return (int32_t)frame->grey[((uint32_t)y * (uint32_t)frame->width) + (uint32_t)x];
}

static inline int32_t rdv_within(int32_t value, int32_t least, int32_t most)
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

/* Median and spread of 3 x 3 means along the border, where only sky should be. */
void rdv_look_at_sky(const rdv_frame *frame, rdv_f64 *level, rdv_f64 *noise);

/* Marks pixels brighter than a level in the mean over 3 x 3 pixels. */
void rdv_mark_target(const rdv_frame *frame, rdv_f64 level);

/* Outer borders of all marked pixels, row by row, the longest; 0 where there are more that may
 * belong to the target. */
uint8_t rdv_find_blobs(const rdv_frame *frame, rdv_blob blobs[RDV_MOST_BLOBS], uint32_t *count);

/* Puts a walker on the first pixel of a border; `back` is where the border comes from. */
void rdv_start_walk(const rdv_frame *frame, int32_t x, int32_t y, rdv_walker *walker);

/* Finds the direction of the next pixel: counter-clockwise from where the border came from. */
void rdv_look_ahead(const rdv_frame *frame, rdv_walker *walker);

/* Moves to the next pixel; 0 where the border is closed. */
uint8_t rdv_go_on(const rdv_blob *blob, rdv_walker *walker);

#endif
