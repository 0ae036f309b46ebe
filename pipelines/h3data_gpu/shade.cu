// Pictures out of the words of the rasteriser, one thread per pixel: ids (`identify`), normals and RGB (`shade`).

#define TONE_SIZE 8192
#define TONE_LIMIT 2.f
#define BRIGHTEST_SAMPLE 5120    // samples are averaged up to this level
#define ONE_LEVEL 0.25f          // so far around whole levels of detail one level is enough
#define NOWHERE 1e-3f            // weight of "not occluded" where no coarse pixel lies on the surface

struct Light { float3 mean, up, sun, fill, headlight, sun_direction, fill_direction, horizon, zenith; };

struct Level { int offset, width, height, following; };

struct Shade {
    World world;
    const float* depth;
    const u32* words;
    const int* triangle_instances;
    const int* triangle_faces;
    const int* instance_ids;     // as pictures show them; both by `Scene::first_instance` and instance
    const int* semantic_ids;
    const float* normals;        // per pool vertex; 0 = flat
    const uchar4* colors;        // sRGB; w = 1 in deformable meshes with smooth normals
    const float2* uv;
    const float* mirrors;        // per pool vertex, 5 each: light that glossy surfaces mirror; 0 = no mesh is glossy
    const int* triangle_textures;
    const Level* levels;
    const int* first_level;
    const u32* texels;
    const int* normal_groups;    // per deformable pool vertex
    const int* group_first;
    const int3* group_faces;     // pool vertices
    const float* linear_of_byte;
    const unsigned char* byte_of_level;
    const float4* surfaces;      // ambient occlusion: slopes of 1/z along x and y, sharpness, 1/z; 0 = none
    const float* occlusion;
    const float* blockers;       // [worlds, blocker_limit, BLOCKER_WORDS]: capsules, as in `blockers_simd.py`
    const int* blocker_counts;   // per world
    const float4* receivers;     // [worlds, receiver_limit] by instance of the scene: tint, group; 0 = no tints, no blockers
    int* instance;
    int* semantic;
    int* triangle;
    float* normal;
    unsigned char* rgb;
    Light light;
    float strength;              // of the occlusion
    int coarse_width, coarse_height;
    int blocker_limit, receiver_limit;
    int samples;                 // 1 or 4: then depth and words are twice as wide and high as `rgb`
};

__device__ __forceinline__ float3 operator+(float3 a, float3 b) { return make_float3(a.x + b.x, a.y + b.y, a.z + b.z); }
__device__ __forceinline__ float3 operator-(float3 a, float3 b) { return make_float3(a.x - b.x, a.y - b.y, a.z - b.z); }
__device__ __forceinline__ float3 operator*(float3 a, float s) { return make_float3(a.x * s, a.y * s, a.z * s); }
__device__ __forceinline__ float3 operator*(float3 a, float3 b) { return make_float3(a.x * b.x, a.y * b.y, a.z * b.z); }
__device__ __forceinline__ float dot(float3 a, float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ __forceinline__ float3 cross(float3 a, float3 b) {
    return make_float3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
__device__ __forceinline__ float3 unit(float3 a) {
    float squared = dot(a, a);
    return squared > 0.f ? a * (1.f / sqrtf(squared)) : make_float3(0, 0, 0);
}
__device__ __forceinline__ float clamp(float x, float low, float high) { return fminf(fmaxf(x, low), high); }

struct Hit {
    Scene scene;
    Place place;
    int cluster, number;         // `number` of the triangle in the pool
    int first_vertex;
};

__device__ __forceinline__ Hit hit_of(const World& s, int world, u32 word) {
    Hit h;
    h.scene = s.scenes[s.scene_of_world[world]];
    int item = h.scene.first_item + (word >> 11);
    h.place = s.places[item];
    h.cluster = bits(s.items[item].center.w) + ((word >> 6) & 31);
    h.number = h.cluster * CLUSTER_TRIANGLES + (word & 63);
    h.first_vertex = bits(s.clusters[h.cluster].half.w);
    return h;
}

struct Ray { float3 inside, direction; };  // (x, y, 1) in the camera's frame; in the world's

__device__ __forceinline__ float3 to_world(const float* camera, float x, float y, float z) {
    return make_float3(camera[0] * x + camera[1] * y + camera[2] * z, camera[4] * x + camera[5] * y + camera[6] * z,
                       camera[8] * x + camera[9] * y + camera[10] * z);
}

// Pixels of the fine picture to units at z = 1.
__device__ __forceinline__ float2 pixel_size(const float* camera, int scale) {
    return make_float2(1.f / (camera[12] * scale), 1.f / (camera[13] * scale));
}

// The ray through a point of the fine picture.
__device__ __forceinline__ Ray ray_at(const float* camera, int scale, float2 pixel, float x, float y) {
    Ray r;
    r.inside = make_float3((x - camera[14] * scale) * pixel.x, (y - camera[15] * scale) * pixel.y, 1.f);
    r.direction = to_world(camera, r.inside.x, r.inside.y, 1.f);
    return r;
}

// Normal of a vertex of a deformed mesh: those of the faces around it, weighted by area.
__device__ float3 deformed_normal(const Shade& f, const float* vertices, int vertex) {
    int group = f.normal_groups[vertex];
    float3 sum = make_float3(0, 0, 0);
    for (int k = f.group_first[group]; k < f.group_first[group + 1]; k++) {
        int3 face = f.group_faces[k];
        const float *a = vertices + 3 * (size_t)face.x, *b = vertices + 3 * (size_t)face.y,
                    *c = vertices + 3 * (size_t)face.z;
        sum = sum + cross(make_float3(b[0] - a[0], b[1] - a[1], b[2] - a[2]),
                          make_float3(c[0] - a[0], c[1] - a[1], c[2] - a[2]));
    }
    return unit(sum);
}

// Squared steps of one texel's channels.
__device__ __forceinline__ float3 texel(u32 word) {
    float r = (float)(word >> 21), g = (float)((word >> 10) & 2047), b = (float)(word & 1023);
    return make_float3(r * r, g * g, b * b);
}

__device__ __forceinline__ int texel_before(float coordinate, int size, float& way) {
    float place = (coordinate - floorf(coordinate)) * size - 0.5f;
    if (place < 0.f) place += size;
    float before = clamp(floorf(place), 0.f, size - 1.f);
    way = place - before;
    return (int)before;
}

__device__ __forceinline__ float3 bilinear(const u32* texels, const Level& level, float2 uv) {
    float right, lower;
    int column = texel_before(uv.x, level.width, right), row = texel_before(uv.y, level.height, lower);
    const u32* at = texels + level.offset + (size_t)row * (level.width + 1) + column;
    float3 upper = texel(at[0]) * (1.f - right) + texel(at[1]) * right;
    at += level.width + 1;
    return upper * (1.f - lower) + (texel(at[0]) * (1.f - right) + texel(at[1]) * right) * lower;
}

struct Surface {              // linear; colours are lit
    float3 color, normal;
    float mirrored, share;   // light that a glossy surface mirrors, and how much it does; 0 = dull
};

#define FACING_SHARE 0.04f
#define GRAZING_SHARE 0.5f

// What a glossy floor mirrors, as `gloss_block` of `shading_simd.py`.
__device__ __forceinline__ void gloss(const Shade& f, const int* v, float b1, float b2, float3 ray, Surface& out) {
    float sides[5];
    bool glossy = false;
    for (int k = 0; k < 5; k++) {
        float corner[3];
        for (int j = 0; j < 3; j++) corner[j] = f.mirrors[5 * (size_t)v[j] + k];
        glossy |= corner[0] > 0.f || corner[1] > 0.f || corner[2] > 0.f;
        sides[k] = corner[0] + (corner[1] - corner[0]) * b1 + (corner[2] - corner[0]) * b2;
    }
    if (!glossy) return;
    ray = unit(ray);
    float facing = clamp(-dot(out.normal, ray), 0.f, 1.f), rest = 1.f - facing;
    float3 to = ray + out.normal * (2.f * facing);
    out.mirrored = fmaxf(to.x * to.x * sides[to.x > 0.f] + (to.y > 0.f ? to.y * to.y * sides[2] : 0.f)
                             + to.z * to.z * sides[3 + (to.z > 0.f)], 0.f);
    out.share = FACING_SHARE + (GRAZING_SHARE - FACING_SHARE) * rest * rest * rest * rest * rest;
}

// What a ray sees of a triangle.
__device__ Surface shade_hit(const Shade& f, int view, u32 word, const Ray& ray, float2 pixel) {
    const World& s = f.world;
    int world = s.world_of_view[view];
    Hit h = hit_of(s, world, word);
    const float* camera = s.cameras + CAMERA_WORDS * (size_t)view;
    const float* m = s.placement + ((size_t)view * s.slots + h.place.slot) * 12;
    const float* vertices = vertices_of(s, h.scene, world, h.place.group);
    u32 packed = s.triangles[h.number];
    int v[3];
    float3 p[3];
    for (int j = 0; j < 3; j++) {
        v[j] = h.first_vertex + ((packed >> (8 * j)) & 255);
        const float* x = vertices + 3 * (size_t)v[j];
        p[j] = make_float3((m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[3]) * pixel.x,
                           (m[4] * x[0] + m[5] * x[1] + m[6] * x[2] + m[7]) * pixel.y,
                           m[8] * x[0] + m[9] * x[1] + m[10] * x[2] + m[11]);
    }
    // where the ray meets the plane, from corner 0, and its barycentrics (differences first: they keep their digits)
    float3 to1 = p[1] - p[0], to2 = p[2] - p[0], n = cross(to1, to2);
    float per_plane = 1.f / dot(n, ray.inside), z = dot(n, p[0]) * per_plane, per_area2 = 1.f / fmaxf(dot(n, n), 1e-38f);
    float3 along1 = cross(to2, n) * per_area2, along2 = cross(n, to1) * per_area2;
    float3 way = ray.inside * z - p[0];
    float b1 = clamp(dot(way, along1), 0.f, 1.f), b2 = clamp(dot(way, along2), 0.f, 1.f);
    float3 flat = unit(n) * (dot(n, p[0]) > 0.f ? -1.f : 1.f);
    flat = to_world(camera, flat.x, flat.y, flat.z);
    float3 corner[3];
    for (int j = 0; j < 3; j++) {
        if (h.place.group >= 0)
            corner[j] = f.colors[v[j]].w ? deformed_normal(f, vertices, v[j]) : make_float3(0, 0, 0);
        else
            corner[j] = make_float3(f.normals[3 * (size_t)v[j]], f.normals[3 * (size_t)v[j] + 1],
                                    f.normals[3 * (size_t)v[j] + 2]);
    }
    if (h.place.slot > 0) {  // cofactors turn normals rightly under any scale
        const float* pose = s.poses + ((size_t)world * (s.slots - 1) + h.place.slot - 1) * 12;
        float3 x = make_float3(pose[0], pose[4], pose[8]), y = make_float3(pose[1], pose[5], pose[9]),
               z = make_float3(pose[2], pose[6], pose[10]);
        float3 yz = cross(y, z), zx = cross(z, x), xy = cross(x, y);
        for (int j = 0; j < 3; j++) corner[j] = unit(yz * corner[j].x + zx * corner[j].y + xy * corner[j].z);
    }
    float side = dot(corner[0] + corner[1] + corner[2], flat);
    float3 normal = flat;
    if (side != 0.f) {
        normal = corner[0] + (corner[1] - corner[0]) * b1 + (corner[2] - corner[0]) * b2;
        normal = normal * ((side < 0.f ? -1.f : 1.f) / sqrtf(fmaxf(dot(normal, normal), 1e-20f)));
    }
    Surface out = {make_float3(0, 0, 0), normal, 0.f, 0.f};
    if (!f.rgb) return out;
    if (f.mirrors) gloss(f, v, b1, b2, ray.direction, out);

    float3 tint[3];
    for (int j = 0; j < 3; j++) {
        uchar4 c = f.colors[v[j]];
        tint[j] = make_float3(f.linear_of_byte[c.x], f.linear_of_byte[c.y], f.linear_of_byte[c.z]);
    }
    const Light& light = f.light;
    float facing = fmaxf(-dot(normal, ray.direction), 0.f) / sqrtf(dot(ray.direction, ray.direction));
    float sunny = fmaxf(dot(normal, light.sun_direction), 0.f), filled = fmaxf(dot(normal, light.fill_direction), 0.f);
    float3 lit = light.mean + light.up * normal.y + light.sun * sunny + light.fill * filled + light.headlight * facing;
    out.color = (tint[0] + (tint[1] - tint[0]) * b1 + (tint[2] - tint[0]) * b2) * lit;

    int texture = f.triangle_textures ? f.triangle_textures[h.number] : -1;
    if (texture >= 0) {
        const Level* levels = f.levels + f.first_level[texture];
        float2 start = f.uv[v[0]], uv1 = f.uv[v[1]], uv2 = f.uv[v[2]];
        uv1.x -= start.x, uv1.y -= start.y, uv2.x -= start.x, uv2.y -= start.y;
        float2 uv = make_float2(start.x - floorf(start.x) + b1 * uv1.x + b2 * uv2.x,
                                start.y - floorf(start.y) + b1 * uv1.y + b2 * uv2.y);
        // the level of detail fits the pixel's longer side on the texture (Williams 1983)
        float largest = 0.f;
        for (int axis = 0; axis < 2; axis++) {
            float size = (axis ? pixel.y : pixel.x) * (f.samples == 4 ? 2.f : 1.f) * z;
            float3 step = ray.inside * (-(axis ? n.y : n.x) * per_plane);  // from pixel to pixel on the plane, over z
            if (axis) step.y += 1.f; else step.x += 1.f;
            float d1 = dot(step, along1) * size, d2 = dot(step, along2) * size;
            float u_step = (d1 * uv1.x + d2 * uv2.x) * levels[0].width, v_step = (d1 * uv1.y + d2 * uv2.y) * levels[0].height;
            largest = fmaxf(largest, u_step * u_step + v_step * v_step);
        }
        float detail = clamp(fmaf((float)bits(largest), 0.5f / (1 << 23), -63.5f), 0.f, (float)levels[0].following);
        int base = (int)(detail + ONE_LEVEL);
        float3 color = bilinear(f.texels, levels[base], uv);
        float fraction = clamp((detail - base - ONE_LEVEL) * (0.5f / ONE_LEVEL), 0.f, 1.f);
        if (fraction > 0.f) color = color + (bilinear(f.texels, levels[base + 1], uv) - color) * fraction;
        const float hair = 1.f + 1e-6f;
        out.color = out.color * color
            * make_float3(hair / (2047.f * 2047.f), hair / (2047.f * 2047.f), hair / (1023.f * 1023.f));
    }
    return out;
}

__device__ __forceinline__ float3 sky(const Light& light, const Ray& ray) {
    float height = clamp(ray.direction.y / sqrtf(dot(ray.direction, ray.direction)), 0.f, 1.f);
    return light.horizon + (light.zenith - light.horizon) * height;
}

// How much light the occlusion leaves at a pixel of the picture, seen at 1/z `near`.
__device__ __forceinline__ float light_left(const Shade& f, int local, int x, int y, float near) {
    float total = 0.f, weights = NOWHERE;
    for (int down = 0; down < 2; down++)
        for (int right = 0; right < 2; right++) {
            int row = (y + down) / 2, column = (x + right) / 2;
            if (row >= f.coarse_height || column >= f.coarse_width) continue;
            u32 at = ((u32)local * f.coarse_height + row) * f.coarse_width + column;
            float4 surface = f.surfaces[at];
            float expected = surface.w + surface.x * 0.5f * (x - 2 * column) + surface.y * 0.5f * (y - 2 * row);
            float weight = fmaxf(1.f - fabsf(near - expected) * surface.z, 0.f);
            total += weight * f.occlusion[at];
            weights += weight;
        }
    return 1.f - f.strength * total / weights;
}

// The instance of a scene that a word shows.
__device__ __forceinline__ int instance_of(const Shade& f, int world, u32 word) {
    const World& s = f.world;
    int item = s.scenes[s.scene_of_world[world]].first_item + (word >> 11);
    int instance = s.places[item].instance;
    if (instance >= 0) return instance;
    return f.triangle_instances[(bits(s.items[item].center.w) + ((word >> 6) & 31)) * CLUSTER_TRIANGLES + (word & 63)];
}

// Words of a capsule and constants of its shadow, as in `blockers_simd.py`.
struct Blocker {
    float3 start, along, light;
    float per_length2, along_light, per_across2, radius, radius2, width, reach, per_range4, group, share, length, per_radius;
};
#define BLOCKER_WORDS 21
#define SPREAD 0.30f
#define FADE_M 0.25f
#define KEPT_M 0.1f
#define DARKEST 0.22f
#define THINNEST_M 0.01f

// What a capsule takes of the light from everywhere.
__device__ __forceinline__ float hidden_by(const Blocker& c, float3 from_start, float3 normal) {
    float s = clamp(dot(from_start, c.along) * c.per_length2, 0.f, 1.f);
    float3 to = c.along * s - from_start;
    float distance2 = fmaxf(dot(to, to), c.radius2), window = fmaxf(1.f - distance2 * distance2 * c.per_range4, 0.f);
    if (window == 0.f) return 0.f;
    float per_distance = 1.f / sqrtf(distance2);
    float covered = 0.5f * (fminf((c.length * s + c.radius) * per_distance, 1.f)
                            + fminf((c.length * (1.f - s) + c.radius) * per_distance, 1.f));
    float facing = fmaxf(dot(normal, to), 0.f) * per_distance;
    return fminf(facing * (c.radius * per_distance) * covered * window * window, 1.f);
}

// What it takes of the light from one direction.
__device__ __forceinline__ float shadow_of(const Blocker& c, float3 from_start) {
    float beside = dot(from_start, c.along), ahead = dot(from_start, c.light);
    float s = clamp((beside - ahead * c.along_light) * c.per_across2, 0.f, 1.f), away = s * c.along_light - ahead;
    if (away <= 0.f || away >= c.reach + (KEPT_M + FADE_M)) return 0.f;
    float3 to = c.along * s - from_start;
    float off = sqrtf(fmaxf(dot(to, to) - away * away, 0.f)), disc = fmaxf(away * SPREAD, THINNEST_M);
    if (off >= disc + c.radius) return 0.f;
    float per_disc = 1.f / disc;
    float step = clamp((disc + c.radius - off) * (fmaxf(per_disc, c.per_radius) * 0.5f), 0.f, 1.f);
    float most = fminf(c.radius * per_disc * fminf(c.width * per_disc, 1.f), 1.f);
    return most * (step * step * (3.f - 2.f * step)) * clamp(away * (c.per_radius * 2.f), 0.f, 1.f)
        * clamp((c.reach + (KEPT_M + FADE_M) - away) * (1.f / FADE_M), 0.f, 1.f);
}

// How much light all capsules leave at a point; those of a group come one after another, and none darkens its own group.
__device__ float unblocked(const Shade& f, int world, float3 point, float3 normal, float group) {
    const Blocker* all = (const Blocker*)(f.blockers + (size_t)world * f.blocker_limit * BLOCKER_WORDS);
    int count = f.blocker_counts[world];
    float left = 1.f, directed = 1.f, ambient = 1.f;
    for (int k = 0; k < count; k++) {
        const Blocker& c = all[k];
        if (c.group == group) continue;
        float3 from_start = point - c.start;
        ambient *= 1.f - hidden_by(c, from_start, normal);
        directed *= 1.f - shadow_of(c, from_start);
        if (k + 1 < count && all[k + 1].group == c.group) continue;
        float share = c.share * fmaxf(dot(normal, c.light), 0.f);
        share /= fmaxf(share + (1.f - c.share) * 0.25f, 1e-6f);
        left *= 1.f - (1.f - DARKEST) * (share * (1.f - directed) + (1.f - share) * (1.f - ambient));
        directed = ambient = 1.f;
    }
    return left;
}

__device__ __forceinline__ float inverse_or_zero(float z) { return z > 0.f ? 1.f / z : 0.f; }

// Ids of what is seen; the pictures have the size of `words`.
extern "C" __global__ void __launch_bounds__(256) identify(Shade f) {
    const World& s = f.world;
    u32 pixel = blockIdx.x * blockDim.x + threadIdx.x, size = s.width * s.height;
    if (pixel >= size * s.views) return;
    u32 word = f.words[pixel];
    int instance = -1, triangle = -1, semantic = -1;
    if (word != NOTHING) {
        const Scene& scene = s.scenes[s.scene_of_world[s.world_of_view[s.first_view + pixel / size]]];
        int item = scene.first_item + (word >> 11);
        int number = (bits(s.items[item].center.w) + ((word >> 6) & 31)) * CLUSTER_TRIANGLES + (word & 63);
        instance = s.places[item].instance;
        if (instance < 0) instance = f.triangle_instances[number];
        if (f.triangle) triangle = f.triangle_faces[number];
        instance += scene.first_instance;
        if (f.semantic) semantic = f.semantic_ids[instance];
        instance = f.instance_ids[instance];
    }
    if (f.instance) f.instance[pixel] = instance;
    if (f.semantic) f.semantic[pixel] = semantic;
    if (f.triangle) f.triangle[pixel] = triangle;
}

extern "C" __global__ void __launch_bounds__(256, 3) shade(Shade f) {
    const World& s = f.world;
    int factor = f.samples == 4 ? 2 : 1, width = s.width / factor, height = s.height / factor;
    u32 pixel = blockIdx.x * blockDim.x + threadIdx.x, row = pixel / width;
    if (pixel >= (u32)s.views * width * height) return;
    int x = pixel - row * width, local = row / height, y = row - local * height;
    int view = s.first_view + local;
    const float* camera = s.cameras + CAMERA_WORDS * (size_t)view;
    u32 fine = ((u32)local * s.height + y * factor) * s.width + x * factor;
    u32 word = f.words[fine];
    const float levels_per_light = TONE_SIZE / TONE_LIMIT;
    const float2 pixel_at_1 = pixel_size(camera, s.scale);
    bool mixed = false;
    if (factor == 2)
        mixed = word != f.words[fine + 1] || word != f.words[fine + s.width] || word != f.words[fine + s.width + 1];
    int world = s.world_of_view[view], level[3] = {0, 0, 0};
    for (int k = 0; k < (mixed ? 4 : 1); k++) {
        u32 at = fine + (k & 1) + (k >> 1) * s.width, seen = f.words[at];
        float2 middle = make_float2(0.5f * factor, 0.5f * factor);
        int alike = 1;
        if (mixed) {  // samples of one triangle are shaded once, in their middle
            int first = 4, right = 0, down = 0;
            alike = 0;
            for (int j = 0; j < 4; j++) {
                if (f.words[fine + (j & 1) + (j >> 1) * s.width] != seen) continue;
                first = min(first, j), alike++, right += j & 1, down += j >> 1;
            }
            if (first < k) continue;
            middle = make_float2(0.5f + (float)right / alike, 0.5f + (float)down / alike);
        }
        Ray ray = ray_at(camera, s.scale, pixel_at_1, x * factor + middle.x, y * factor + middle.y);
        Surface surface = {make_float3(0, 0, 0), make_float3(0, 0, 0), 0.f, 0.f};
        if (seen != NOTHING)
            surface = shade_hit(f, view, seen, ray, pixel_at_1);
        else if (f.rgb)
            surface.color = sky(f.light, ray);
        if (f.normal) {
            float* out = f.normal + 3 * (size_t)pixel;
            out[0] = surface.normal.x, out[1] = surface.normal.y, out[2] = surface.normal.z;
        }
        if (!f.rgb) continue;
        float unshadowed = 1.f;
        if (f.receivers && seen != NOTHING) {
            float4 own = f.receivers[(size_t)world * f.receiver_limit + instance_of(f, world, seen)];
            surface.color = surface.color * make_float3(own.x, own.y, own.z);
            if (f.blocker_counts[world]) {
                float3 eye = make_float3(camera[3], camera[7], camera[11]);
                unshadowed = unblocked(f, world, eye + ray.direction * f.depth[at], surface.normal, own.w);
            }
        }
        float left = f.strength > 0.f ? light_left(f, local, x, y, inverse_or_zero(f.depth[at])) : 1.f;
        float color[3] = {surface.color.x, surface.color.y, surface.color.z};
        for (int a = 0; a < 3; a++) {
            int own = (int)clamp(color[a] * levels_per_light, 0.f, TONE_SIZE - 1.f);
            if (surface.share > 0.f)
                own = (int)clamp(own * (1.f - surface.share) + surface.mirrored * surface.share * levels_per_light, 0.f,
                                 TONE_SIZE - 1.f);
            level[a] += (int)((int)((mixed ? min(own, BRIGHTEST_SAMPLE) : own) * left) * unshadowed) * alike;
        }
    }
    if (f.rgb)
        for (int a = 0; a < 3; a++) f.rgb[3 * (size_t)pixel + a] = f.byte_of_level[mixed ? level[a] >> 2 : level[a]];
}
