/* rendezview: recognises a spacecraft's view from its outline; flight code in plain C99.
 *
 * grey frame --rdv_silhouette--> outline --rdv_rays--> rays --rdv_signature_of--> signature
 *            --rdv_search--> active nodes and the direction on which they agree
 *            --rdv_forest_score--> how well an attitude fits
 *
 * No allocation, no recursion, no state between calls, nothing of the library but math.h. All
 * memory is the caller's or on the stack. Sizes and worst-case counts: rendezview_model.h, which
 * belongs to one target. Frames, signs and units: README.md beside this file.
 *
 * Source of the method: T. F. Cleghorn and S. R. Sternberg, Autonomous Proximity Operations Using
 * Machine Vision for Trajectory Control and Pose Estimation, NASA, 1991 (N91-20656).
 */
#ifndef RENDEZVIEW_FLIGHT_H
#define RENDEZVIEW_FLIGHT_H

#include <float.h>
#include <stdint.h>

typedef float rdv_f32;  /* IEEE 754 binary32 */
typedef double rdv_f64; /* IEEE 754 binary64 */

#include "rendezview_model.h"

#if (FLT_EVAL_METHOD != 0)
#error "float must be rounded after every operation: -msse2 -mfpmath=sse on 32-bit x86"
#endif

typedef enum
{
    RDV_OK = 0,
    RDV_EMPTY,        /* nothing stands out from the background */
    RDV_FULL,         /* target or glare fill the frame */
    RDV_BORDER,       /* the silhouette touches the border */
    RDV_SMALL,        /* too few pixels, or the outline encloses nothing */
    RDV_RIVALS,       /* several bodies of like size */
    RDV_UNRECOGNIZED, /* no node is active */
    RDV_NO_ROOM,      /* more blobs or outline points than there is room for */
    RDV_BAD_INPUT     /* a null pointer, a size out of range, or a number that is not finite */
} rdv_status;

/* ---- Frame to outline: silhouette.c ---- */

#define RDV_LEAST_SIDE 8u    /* smallest width and height of a frame, pixels */
#define RDV_MOST_SIDE 16384u /* largest */

/* Bodies, parts and specks distinguished in one frame; each takes 52 bytes of the stack. */
#ifndef RDV_MOST_BLOBS
#define RDV_MOST_BLOBS 256u
#endif

/* Bytes of work memory for a frame. */
#define RDV_WORK_BYTES(width, height) (((width) + 2u) * ((height) + 2u))

typedef struct
{
    rdv_f64 x;
    rdv_f64 y;
} rdv_point;

typedef struct
{
    rdv_f64 noise_sigmas;        /* threshold above the sky, in sigmas of its noise ... */
    rdv_f64 least_contrast_grey; /* ... but at least so many grey levels */
    rdv_f64 least_area_px;       /* of the largest blob */
    rdv_f64 speck_fraction;      /* of the largest blob: below it, noise */
    rdv_f64 merge_gap;           /* of the largest blob's size: parts within it belong together */
    rdv_f64 rival_fraction;      /* of the largest blob's area: another body */
    uint32_t reach_px;           /* inside the border, to find the target's own level */
} rdv_silhouette_options;

extern const rdv_silhouette_options rdv_default_silhouette;

typedef struct
{
    rdv_f64 area_px;
    rdv_f64 sky_grey;
    rdv_f64 level_grey;
    int32_t left, top, right, bottom; /* inclusive */
    uint32_t outlines;
    uint32_t ends[RDV_MOST_BLOBS]; /* of each outline, the index after its last point */
} rdv_silhouette_found;

/* Outlines of the target in an 8-bit grey frame, row by row, no gaps; the target is brighter than
 * the sky. Pixel (0, 0) is the centre of the top-left pixel; outlines run counter-clockwise as
 * seen on the screen. Where the target's centre is expected is known or NULL: of several bodies the
 * nearest is taken, and none is called a rival. `work` has RDV_WORK_BYTES(width, height) bytes.
 * RDV_NO_ROOM where the outlines have more than `most_points` points; each step along a border
 * gives at most 3. */
rdv_status rdv_silhouette(const uint8_t *grey, uint32_t width, uint32_t height,
                          const rdv_silhouette_options *options, const rdv_point *expected_px,
                          uint8_t *work, rdv_point *points, uint32_t most_points,
                          rdv_silhouette_found *found);

/* ---- Outline to signature: signature.c ---- */

typedef struct
{
    rdv_f64 fx;
    rdv_f64 fy;
    rdv_f64 cx;
    rdv_f64 cy;
} rdv_pinhole; /* pixels */

typedef struct
{
    rdv_f32 readings[RDV_BINS];     /* whole thousandths of sqrt(area), smoothed */
    rdv_f64 area_sr;                /* on the sphere of directions */
    rdv_f64 centred_from_camera[9]; /* row by row: turns the centroid to the boresight */
} rdv_signature;

/* Pixels to x/z and y/z in the camera frame, in place. A camera with lens distortion needs its
 * own inverse here. */
void rdv_rays(const rdv_pinhole *camera, rdv_point *points, uint32_t count);

/* Signature of outlines given as rays (x, y, 1); RDV_SMALL if they enclose nothing. */
rdv_status rdv_signature_of(const rdv_point *rays, const uint32_t *ends, uint32_t outlines,
                            rdv_signature *signature);

/* ---- Signature to active nodes: trees.c ---- */

typedef struct
{
    uint32_t count;
    uint16_t nodes[RDV_NODES];  /* active ones, ascending */
    rdv_f64 trust[RDV_NODES];   /* probability that each is active, 0 ... 1 */
    rdv_f64 weights[RDV_NODES]; /* trust times nearness to the direction */
    rdv_f64 support;            /* sum of the weights: how well the nodes agree */
    rdv_f64 direction[3];       /* unit, view centre to camera, target frame */
} rdv_on_nodes;

/* All trees, each with the roll of the view against its node, -pi ... pi; trust[k] > 0 where
 * node k is on. */
rdv_status rdv_all_trees(const rdv_f32 readings[RDV_BINS], const rdv_f64 rolls_rad[RDV_NODES],
                         rdv_f64 trust[RDV_NODES]);

/* Attitude of the camera turned to the centroid, when the camera has `camera_from_target`;
 * rotations row by row. */
void rdv_centred(const rdv_signature *signature, const rdv_f64 camera_from_target[9],
                 rdv_f64 centred_from_target[9]);

/* Active nodes within `reach_rad` of the view of an attitude (RDV_REACH_RAD where it is known
 * well), each asked at its own roll; RDV_UNRECOGNIZED where there are none. */
rdv_status rdv_search(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                      rdv_f64 reach_rad, rdv_on_nodes *found);

/* The same where an attitude is only known to `error_rad`, at most pi: rolls of the view up to that
 * far either way are tried two degrees apart, and the one on which the nodes agree best is taken.
 * Nodes are asked that far and RDV_MARGIN_RAD around the view. */
rdv_status rdv_search_around(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                             rdv_f64 error_rad, rdv_on_nodes *found);

/* Parts of a search. The nodes whose directions have at least this cosine with the view of an
 * attitude, ascending; and, of nodes and trust, the weights, the support and the direction. */
rdv_status rdv_nodes_near(const rdv_f64 centred_from_target[9], rdv_f64 cosine,
                          uint16_t near[RDV_NODES], uint32_t *count);
void rdv_agree(rdv_on_nodes *found);

/* ---- The forest, with which the runtime decides: forest.c and rendezview_forest.c ---- */

#if (RDV_FOREST_TREES > 0u) /* else the model has none, and these functions are left out */

/* Mean log odds that the signature is a view of each of the nodes within an edge of the attitude's
 * view, each asked at its own roll: a score to compare attitudes by. */
rdv_status rdv_forest_score(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                            rdv_f64 *score);

/* As rdv_search, but the forest decides which nodes are active. */
rdv_status rdv_forest_search(const rdv_signature *signature, const rdv_f64 centred_from_target[9],
                             rdv_f64 reach_rad, rdv_on_nodes *found);

#endif

#endif
