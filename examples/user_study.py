"""One idea: from a study's plan to its table. Usage: python examples/user_study.py [PICTURE.png]"""

import sys

from PIL import Image, ImageDraw, ImageFont

from h3data_studies.analysis import plan_sessions, simulate_study
from h3data_studies.statistics import (
    MarginalMeans,
    contrasts,
    contrasts_text,
    fit_glmm,
    marginal_means,
    relative_efficiency,
)


def draw(means: MarginalMeans, path: str) -> None:
    """Draw estimated means as dots, and 95% intervals as bars."""
    ends, most = means.intervals(), float(means.intervals().max()) * 1.1
    picture = Image.new("RGB", (720, 60 + 50 * len(means.levels)), "white")
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(18)
    for tick in range(0, int(most), 250):
        x = 150 + 550 * tick / most
        pen.line((x, 15, x, picture.height - 35), fill="#dddddd")
        pen.text((x, picture.height - 30), str(tick), fill="black", font=font, anchor="ma")
    for k, (name, mean, (low, high)) in enumerate(zip(means.levels, means.means, ends, strict=True)):
        y = 40 + 50 * k
        pen.text((10, y), name, fill="black", font=font, anchor="lm")
        pen.line((150 + 550 * low / most, y, 150 + 550 * high / most, y), fill="#1f77b4", width=4)
        pen.circle((150 + 550 * mean / most, y), 7, fill="#1f77b4")
    picture.save(path)


episodes = {f"scene{k}": [f"scene{k}-{j}" for j in range(40)] for k in range(10)}
sessions = plan_sessions(30, ["solo", "learn_single", "plan_pop3"], episodes, seed=1)
table = simulate_study(
    sessions,
    {"solo": 1253, "learn_single": 937, "plan_pop3": 1015},
    "poisson",
    deviations={"participant": 0.3, "scene": 0.2, "observation": 0.25},
    seed=1,
)
fit = fit_glmm(
    table, "response", "poisson", fixed=["condition"], random=["participant", "scene"], observation_effect=True
)
print(fit.to_text(), end="\n\n")
means = marginal_means(fit, "condition")
print(means.to_text(), end="\n\n")
print(contrasts_text(contrasts(means)), end="\n\n")
for e in relative_efficiency(means, "solo"):
    print(f"RE {e.level}: {e.percent:.1f}% [{e.low:.1f}, {e.high:.1f}]")
if len(sys.argv) > 1:
    draw(means, sys.argv[1])
