"""Tables of objects that residents leave in rooms: on surfaces by furniture, and on floors by kind of room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Manner = Literal["scatter", "stack", "row", "settings", "pair"]
"""Arrangement of objects: apart from each other; stacked; side by side at the back; plate, cutlery and glass per seat;
or two of one kind."""


@dataclass(frozen=True)
class Habit:
    """Rule for objects that residents leave in a place: their kinds, number and arrangement."""

    manner: Manner
    kinds: tuple[str, ...]
    count: tuple[int, int]
    """Smallest and largest number of objects."""
    weight: float = 1.0


def _habit(manner: Manner, kinds: str, low: int, high: int, weight: float = 1.0) -> Habit:
    return Habit(manner, tuple(kinds.split()), (low, high), weight)


_READING = "book magazine open_book newspaper notebook"
_DECOR = "vase flower_vase candle candlestick photo_frame sculpture succulent cactus snow_globe lantern basket"
_TOYS = (
    "toy_car toy_truck toy_train toy_blocks teddy_bear toy_rabbit ball doll toy_robot stacking_rings toy_dinosaur "
    "toy_plane magic_cube crayon_box toy_drum xylophone toy_boat toy_bucket puzzle_box"
)
_TOOLS = (
    "toolbox hammer screwdriver wrench pliers drill paint_can paint_brush spirit_level tape_measure oil_can work_gloves "
    "flashlight cable_reel"
)
_WORK = (
    "laptop keyboard computer_mouse notebook pen_cup stapler tape_dispenser calculator paper_stack letters mug "
    "desk_lamp smartphone binder tablet"
)
_BATH = "toothbrush_cup toothpaste soap_dispenser soap_bar cream_jar perfume hairbrush hair_dryer shampoo"
_FRUIT = "apple orange banana pear lemon tomato bell_pepper"
_SHELVES = (
    _habit("row", "book_row", 1, 3, 2.0),
    _habit("stack", "book magazine", 2, 4),
    _habit("scatter", _DECOR, 1, 3, 1.5),
    _habit("scatter", "radio speaker globe board_game camera record_player alarm_clock", 1, 2),
)

ON_FURNITURE: Mapping[str, tuple[Habit, ...]] = {
    "sink": (
        _habit("scatter", "dish_soap sponge mug tumbler spoon", 2, 4, 1.0),
        _habit("stack", "dessert_plate", 2, 5, 1.5),
        _habit("scatter", "dish_rack", 1, 1, 1.5),
    ),
    "kitchen_counter": (
        _habit(
            "scatter", "kettle toaster coffee_machine blender microwave rice_cooker stand_mixer bread_box", 1, 1, 2.0
        ),
        _habit(
            "scatter",
            "knife_block utensil_jar cutting_board storage_jar spice_jar pepper_mill salt_shaker jam_jar",
            2,
            4,
            2.0,
        ),
        _habit(
            "scatter",
            f"fruit_bowl cutting_board bread cheese {_FRUIT} milk_carton yoghurt egg_box bottle box",
            2,
            4,
            1.5,
        ),
        _habit("stack", "plate", 2, 5, 0.7),
        _habit("scatter", "pot pan casserole colander measuring_cup kitchen_scale rolling_pin", 1, 2),
        _habit("scatter", "mug bowl can bottle paper_towel lunch_box thermos jug potted_herb", 1, 3),
    ),
    "kitchen_island": (
        _habit("scatter", f"fruit_bowl flower_vase cutting_board jug tray {_FRUIT}", 2, 5, 2.0),
        _habit("scatter", "wine_glass tumbler bottle mug plate newspaper cake", 2, 5),
    ),
    "dining_table": (
        _habit("settings", "plate fork table_knife tumbler", 2, 8, 2.0),
        _habit("scatter", "fruit_bowl flower_vase candlestick jug teapot teacup salt_shaker pepper_mill", 2, 4, 1.5),
        _habit("scatter", "laptop letters newspaper mug notebook pizza_box cake crayon_box", 2, 4),
    ),
    "coffee_table": (
        _habit("stack", "book magazine", 2, 4, 1.5),
        _habit("scatter", f"remote_control mug {_READING} candle teacup bowl game_controller", 2, 4, 2.0),
        _habit("scatter", "flower_vase succulent chocolate_bar sunglasses smartphone tray", 1, 2),
    ),
    "side_table": (_habit("scatter", "table_lamp mug teacup open_book remote_control succulent radio", 1, 2),),
    "tv_stand": (
        _habit("scatter", "speaker game_console router photo_frame succulent candle remote_control vase", 1, 1),
    ),
    "sideboard": (
        _habit("scatter", f"{_DECOR} table_lamp record_player radio globe tray", 2, 4, 2.0),
        _habit("stack", "plate", 2, 4, 0.4),
    ),
    "chest_of_drawers": (
        _habit("scatter", f"jewelry_box perfume table_lamp alarm_clock hairbrush {_DECOR}", 2, 4),
        _habit("stack", "folded_shirt folded_jeans", 2, 4),
    ),
    "shelf": _SHELVES,
    "low_bookcase": _SHELVES,
    "wall_shelf": (
        _habit("row", "book_row", 1, 2),
        _habit("scatter", _DECOR, 2, 4, 2.0),
        _habit("row", "binder", 2, 5, 0.4),
    ),
    "console": (
        _habit("scatter", "keys wallet sunglasses letters vase flower_vase photo_frame hat handbag umbrella", 1, 3),
    ),
    "bench": (_habit("scatter", "backpack handbag book folded_scarf cap gloves", 1, 2),),
    "shoe_rack": (_habit("pair", "sneaker leather_shoe boot slipper sandal", 1, 3),),
    "sofa": (_habit("scatter", f"{_READING} remote_control headphones tablet teddy_bear", 1, 2),),
    "armchair": (_habit("scatter", "book folded_scarf headphones tablet", 1, 1),),
    "rocking_chair": (_habit("scatter", "book folded_scarf", 1, 1),),
    "bed": (
        _habit("scatter", "book folded_shirt laptop tablet headphones handbag", 1, 2),
        _habit("stack", "folded_jeans folded_shirt", 2, 3),
    ),
    "bunk_bed": (_habit("scatter", "teddy_bear toy_rabbit doll book", 1, 3),),
    "nightstand": (_habit("scatter", "alarm_clock book smartphone tumbler cream_jar mug", 1, 2),),
    "desk": (_habit("scatter", _WORK, 2, 3),),
    "filing_cabinet": (
        _habit("scatter", "printer", 1, 1, 2.0),
        _habit("scatter", "paper_stack binder cactus globe", 1, 2),
    ),
    "bathroom_sink": (_habit("scatter", _BATH, 1, 3),),
    "toilet": (_habit("scatter", "toilet_roll perfume potted_herb", 1, 1),),
    "linen_cabinet": (_habit("stack", "folded_towel", 2, 4),),
    "washer": (
        _habit("scatter", "detergent spray_bottle wash_basket_small box", 1, 2),
        _habit("stack", "folded_towel", 2, 3),
    ),
    "dryer": (
        _habit("stack", "folded_towel folded_shirt", 2, 4),
        _habit("scatter", "wash_basket_small peg_basket iron", 1, 2),
    ),
    "ironing_board": (_habit("scatter", "iron folded_shirt", 1, 2),),
    "fridge": (_habit("scatter", "box basket bread_box", 1, 1),),
    "toy_chest": (_habit("scatter", _TOYS, 1, 3),),
    "toy_shelf": (_habit("scatter", _TOYS, 2, 4),),
    "kids_table": (_habit("scatter", f"crayon_box toy_blocks puzzle_box notebook {_TOYS}", 2, 4),),
    "workbench": (_habit("scatter", _TOOLS, 3, 6),),
    "tool_cabinet": (_habit("scatter", _TOOLS, 1, 3),),
    "storage_rack": (_habit("scatter", "paint_can jerrycan toolbox bike_helmet oil_can cable_reel bucket", 1, 3),),
    "freezer_chest": (_habit("scatter", "box basket toolbox bike_helmet", 1, 2),),
    "balcony_table": (_habit("scatter", "mug teacup potted_herb sunglasses newspaper lantern wine_glass", 1, 3),),
    "bar_cart": (_habit("scatter", "wine_glass bottle tumbler", 2, 4),),
    "wine_rack": (_habit("scatter", "wine_glass bottle basket", 1, 3),),
    "piano": (_habit("scatter", "candlestick photo_frame sculpture vase", 1, 3),),
}
"""Habits by the furniture that has the surface; ``sink`` is the worktop next to a sink."""

CHANCE: Mapping[str, float] = {
    "dining_table": 1.0,
    "kitchen_counter": 0.9,
    "sink": 1.0,
    "coffee_table": 0.95,
    "shelf": 0.55,
    "low_bookcase": 0.6,
    "sofa": 0.35,
    "armchair": 0.3,
    "rocking_chair": 0.4,
    "bed": 0.4,
    "desk": 1.0,
    "workbench": 1.0,
    "shoe_rack": 0.9,
    "toy_chest": 0.8,
    "toy_shelf": 0.9,
    "kids_table": 1.0,
    "tv_stand": 0.5,
    "toilet": 0.5,
}
"""Probability that objects lie on a surface, by furniture; 0.7 for other furniture."""

ON_FLOOR: Mapping[str, tuple[Habit, ...]] = {
    "hall": (
        _habit("pair", "sneaker leather_shoe boot rubber_boot sandal", 1, 4),
        _habit("scatter", "backpack handbag ball umbrella", 0, 1),
    ),
    "child": (_habit("scatter", _TOYS, 4, 9), _habit("pair", "slipper sneaker", 0, 1)),
    "living": (
        _habit("scatter", "toy_car ball toy_blocks basket magazine game_controller backpack", 0, 3),
        _habit("pair", "slipper", 0, 1),
    ),
    "den": (_habit("scatter", "dumbbell ball yoga_mat board_game", 0, 2),),
    "bedroom": (
        _habit("pair", "slipper sneaker", 0, 2),
        _habit("scatter", "handbag dumbbell yoga_mat book basket", 0, 2),
    ),
    "office": (_habit("scatter", "backpack paper_stack binder router", 0, 2),),
    "bathroom": (
        _habit("scatter", "bathroom_scale toilet_brush rubber_duck bucket", 1, 2),
        _habit("pair", "slipper", 0, 1),
    ),
    "laundry": (_habit("scatter", "detergent bucket basket spray_bottle", 1, 2),),
    "kitchen": (_habit("scatter", "basket", 0, 1),),
    "garage": (
        _habit("scatter", "paint_can jerrycan toolbox bucket ball cable_reel oil_can watering_can", 2, 5),
        _habit("pair", "rubber_boot", 0, 1),
    ),
    "balcony": (_habit("scatter", "watering_can garden_trowel toy_bucket lantern", 1, 2),),
}
"""Habits for floors by kind of room; the objects lie close to walls and furniture, out of the way."""
