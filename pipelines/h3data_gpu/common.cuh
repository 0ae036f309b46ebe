// Types and constants that all kernels share. Every kernel takes one struct by value; `layout.py` mirrors them.
typedef unsigned long long u64;
typedef unsigned int u32;

#define FULL 0xffffffffu
#define CLUSTER_TRIANGLES 64
#define CLUSTER_VERTICES 128
#define CAMERA_WORDS 18
#define NOTHING 0xffffffffu  // word of a pixel that hits nothing; else: item << 11 | cluster of the item << 6 | triangle

struct Box {
    // of a cluster: center.w = vertices | triangles << 16 | cut out << 31, half.w = first vertex
    // of an item:   center.w = first cluster,              half.w = number of clusters      (int bits)
    float4 center, half;
};

struct Place {
    int slot;              // 0 = the world itself, 1.. = pose slot - 1
    u32 layer;             // bit that a camera's mask may hide
    int group;             // deformed group of the world's scene, -1 = rigid
    int instance;          // -1: `triangle_instances` says
};

struct Scene {
    int first_item, items, first_instance;
    int first_group, groups;                // deformed groups
    int first_vertex, first_cluster;        // where the scene's deformable meshes begin in the pools
    int unused;
};

struct Group {             // a piece of a deformable mesh
    int first_cluster, clusters;
    int body;              // which of the scene's deformable meshes
    int first_source;      // row of its first vertex in `sources`, -1 = skinned
};

struct World {             // geometry, and where it is at the moment
    const float* vertices;
    const u32* triangles;
    const Box* clusters;
    const Box* items;
    const Place* places;
    const Scene* scenes;
    const int* scene_of_world;
    const int* world_of_view;
    const Group* groups;
    const float* poses;    // [worlds, slots - 1, 12], mesh to world
    const float* cameras;  // [views, CAMERA_WORDS]: 3x4 camera to world, fx, fy, cx, cy, near, far
    const u32* hidden;     // [views]: layers that are left out
    float* placement;      // [views, slots, 12]: mesh to camera, rows x and y times the focal lengths
    float* deformed;       // [worlds, deformed_vertices, 3]
    Box* deformed_clusters;
    Box* deformed_groups;
    int slots, deformed_vertices, deformed_cluster_count, deformed_group_count;
    int width, height, first_view, views;
    int scale;             // pixels per camera pixel and axis
    int unused;
};

__device__ __forceinline__ int bits(float x) { return __float_as_int(x); }

__device__ __forceinline__ const float* vertices_of(const World& s, const Scene& scene, int world, int group) {
    // so that the pool's vertex numbers fit either store
    if (group < 0) return s.vertices;
    return s.deformed + ((size_t)world * s.deformed_vertices - scene.first_vertex) * 3;
}
