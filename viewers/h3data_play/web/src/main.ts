import { Hud } from "./screen/hud.ts";
import { play } from "./session.ts";
import { takePart } from "./study/study.ts";

const hud = new Hud();
void (document.body.dataset.study === undefined ? play(hud) : takePart(hud));
