// Ambient occlusion on a picture of half the size (scalable ambient obscurance, McGuire et al. 2012), as `occlusion.py`.

#define TAPS 12
#define FAR_PADDING 1e30f        // 1/z around the picture: on no surface
#define BIAS_M 0.004f
#define BIAS_PER_M 0.001f
#define SAME_SURFACE_M 0.05f

struct Occlude {
    const float* depth;
    const float* cameras;        // [views, CAMERA_WORDS]
    const float2* offsets;       // [4, TAPS, 8] on the unit disc
    float4* surfaces;            // out: slopes of 1/z along x and y, sharpness, 1/z
    float* amounts;              // out, 0..1
    const float* source;         // for the blur
    int width, height;           // of the depth
    int factor;                  // pixels of the depth per coarse pixel
    int coarse_width, coarse_height;
    int scale, first_view, views;
    int along_y;
    float radius, near_radius, gain;
};

struct Coarse { u32 at; int picture, x, y; bool inside; };

__device__ __forceinline__ Coarse coarse_pixel(const Occlude& f) {
    u32 k = blockIdx.x * blockDim.x + threadIdx.x, row = k / f.coarse_width;
    Coarse c;
    c.picture = row / f.coarse_height;
    c.inside = c.picture < f.views;
    c.x = k - row * f.coarse_width;
    c.y = row - c.picture * f.coarse_height;
    c.at = k;
    return c;
}

__device__ __forceinline__ float z_at(const Occlude& f, int picture, int x, int y) {
    return f.depth[((u32)picture * f.height + y * f.factor) * f.width + x * f.factor];
}

__device__ __forceinline__ float nearness(const Occlude& f, int picture, int x, int y) {
    if (x < 0 || y < 0 || x >= f.coarse_width || y >= f.coarse_height) return FAR_PADDING;
    float z = z_at(f, picture, x, y);
    return z > 0.f ? 1.f / z : 0.f;
}

// Step of 1/z to the next pixel, from the side on which the surface goes on straight.
__device__ __forceinline__ float slope(float before2, float before, float middle, float after, float after2) {
    float left = middle - before, right = after - middle;
    return fabsf(left - (before - before2)) <= fabsf((after2 - after) - right) ? left : right;
}

extern "C" __global__ void __launch_bounds__(256) occlude(Occlude f) {
    Coarse c = coarse_pixel(f);
    if (!c.inside) return;
    int picture = c.picture;
    const float* camera = f.cameras + CAMERA_WORDS * (f.first_view + picture);
    float near[2][5];
    for (int k = -2; k <= 2; k++) {
        near[0][k + 2] = nearness(f, picture, c.x + k, c.y);
        near[1][k + 2] = nearness(f, picture, c.x, c.y + k);
    }
    float here = near[0][2];
    float slope_x = slope(near[0][0], near[0][1], here, near[0][3], near[0][4]);
    float slope_y = slope(near[1][0], near[1][1], here, near[1][3], near[1][4]);

    // the surface's plane over the ray (u, v, 1); its distance from the eye is 1 / |its coefficients|
    float per_pixel = (float)f.scale / f.factor;
    float fx = camera[12] * per_pixel, fy = camera[13] * per_pixel;
    float u = (c.x - (camera[14] * f.scale - 0.5f) / f.factor) / fx, v = (c.y - (camera[15] * f.scale - 0.5f) / f.factor) / fy;
    float plane_u = slope_x * fx, plane_v = slope_y * fy, plane_1 = here - plane_u * u - plane_v * v;
    float distance = 1.f / sqrtf(fmaxf(plane_u * plane_u + plane_v * plane_v + plane_1 * plane_1, 1e-18f));
    float z = 1.f / fmaxf(here, 1e-6f), eye_x = u * z, eye_y = v * z;
    float radius = fminf(f.radius, f.near_radius * z), per_radius2 = 1.f / (radius * radius);
    float reach_x = radius * fx * here, reach_y = radius * fy * here, bias = z * BIAS_PER_M + BIAS_M;
    const float2* offsets = f.offsets + (c.y & 3) * TAPS * 8 + (c.x & 7);
    float total = 0.f;
    for (int k = 0; k < TAPS; k++) {
        float2 to = offsets[k * 8];
        float sx = floorf(fminf(fmaxf(fmaf(to.x, reach_x, (float)c.x) + 0.5f, 0.f), f.coarse_width - 1.f));
        float sy = floorf(fminf(fmaxf(fmaf(to.y, reach_y, (float)c.y) + 0.5f, 0.f), f.coarse_height - 1.f));
        float seen = z_at(f, picture, (int)sx, (int)sy), sz = seen > 0.f ? seen : 1e6f;
        float dx = sx - c.x, dy = sy - c.y;
        float rise = distance * (1.f - (here + slope_x * dx + slope_y * dy) * sz);
        float ex = (u + dx / fx) * sz - eye_x, ey = (v + dy / fy) * sz - eye_y, ez = sz - z;
        float apart2 = ex * ex + ey * ey + ez * ez;
        total += fmaxf(rise - bias, 0.f) * fmaxf(1.f - apart2 * per_radius2, 0.f) / sqrtf(apart2 + 1e-6f);
    }
    float amount = fmaxf(total * f.gain, 0.f);
    f.surfaces[c.at] = make_float4(slope_x, slope_y, distance * z / SAME_SURFACE_M, here);
    f.amounts[c.at] = here > 0.f ? amount / (amount + 1.f) : 0.f;
}

// Along one axis, over what lies on the same surface.
extern "C" __global__ void __launch_bounds__(256) blur(Occlude f) {
    Coarse c = coarse_pixel(f);
    if (!c.inside) return;
    const float weights[5] = {0.5f, 1.f, 1.f, 1.f, 0.5f};
    int place = f.along_y ? c.y : c.x, count = f.along_y ? f.coarse_height : f.coarse_width;
    int step = f.along_y ? f.coarse_width : 1;
    float4 surface = f.surfaces[c.at];
    float slope = f.along_y ? surface.y : surface.x, amounts = 0.f, sum = 0.f;
    for (int k = -2; k <= 2; k++) {
        if (place + k < 0 || place + k >= count) continue;
        u32 other = c.at + k * step;
        float weight = weights[k + 2];
        if (k) weight *= fmaxf(1.f - fabsf(f.surfaces[other].w - (surface.w + slope * k)) * surface.z, 0.f);
        amounts += weight * f.source[other];
        sum += weight;
    }
    f.amounts[c.at] = amounts / sum;
}
