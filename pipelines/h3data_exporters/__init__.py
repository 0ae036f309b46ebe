"""Export of recordings to the formats of other tools: CSV, Foxglove, glTF, LeRobot, Minari and robomimic."""

from h3data.formats import Format

FOXGLOVE = Format(
    name="foxglove",
    title="a log for Foxglove and Lichtblick",
    write="h3data_exporters.foxglove.foxglove_file:export_foxglove",
    write_options=("assets", "people", "stand_ins", "cameras"),
)
LEROBOT = Format(
    name="lerobot",
    title="a LeRobot dataset",
    write="h3data_exporters.lerobot:export_lerobot",
    write_options=("agent", "assets", "people", "stand_ins", "cameras"),
    target="dataset",
    many=True,
)
ROBOMIMIC = Format(
    name="robomimic",
    title="demonstrations for robomimic",
    write="h3data_exporters.robomimic:export_robomimic",
    write_options=("agent",),
    many=True,
)
MINARI = Format(
    name="minari",
    title="a Minari dataset",
    write="h3data_exporters.minari:export_minari",
    write_options=("agent",),
    target="folder",
    many=True,
)
CSV = Format(name="csv", title="CSV tables", write="h3data_exporters.csv_tables:export_csv", target="folder")
GLTF = Format(
    name="gltf",
    title="an animated glTF model",
    write="h3data_exporters.gltf_animation:export_gltf",
    write_options=("assets", "person_detail", "people", "stand_ins"),
)
