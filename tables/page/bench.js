/* The page: what one can change, what is drawn when, and the numbers. */

const REFERENCE = "reference", OWN = "own";
const LABELS = { ltc: "LTC", ltsh2: "LTSH 2", ltsh4: "LTSH 4", ltsh4c: "LTSH 4c", own: "Own", reference: "Reference" };
const PRESETS = { own_point: "a representative point", own_bent: "LTSH 4, bent normal", own_empty: "diffuse light alone" };
const SLIDERS = {
    Surfaces: [
        ["roughness", "Roughness", 0.05, 1, 0.01], ["metal", "Metal", 0, 1, 0.01],
        ["anisotropy", "Anisotropy", -0.8, 0.8, 0.01], ["floor", "Floor", 0.05, 1, 0.01],
    ],
    Light: [
        ["width", "Width", 0.05, 4, 0.01, " m"], ["height", "Height", 0.05, 3, 0.01, " m"],
        ["y", "Depth", -3, 4, 0.01, " m"], ["turn", "Turn", -180, 180, 1, "°"], ["tilt", "Tilt", -90, 90, 1, "°"],
    ],
    View: [["exposure", "Exposure", -4, 4, 0.1], ["orbit", "Orbit", -180, 180, 1, "°"], ["rise", "Rise", 2, 80, 1, "°"]],
};
const ERROR_SCALE = 0.1; // of white
const POINTS = 8; // of the reference, in a draw
const FIRST_POINTS = 16, MOST_POINTS = 4096, LEAST_NOISE = 5e-4;
const FRAME_MS = 12; // of work in a frame at rest
const NEXT_FRAME = null; // in place of a task: what follows waits for the next frame
const STILL_MS = 1000, MOVING_MS = 28; // a picture on the stage may take as long, at rest in bands
const BAND_MS = 40; // of work on the fine stage at a time: a click need not wait longer
const LARGEST_STAGE = 4; // times the width of the small pictures

const element = id => document.getElementById(id);
const percent = value => `${(100 * value).toFixed(value < 0.0995 ? 2 : 1)} %`;
const milliseconds = value => value < 9.95 ? `${value.toFixed(value < 0.995 ? 2 : 1)} ms` : `${Math.round(value)} ms`;

function created(parent, tag, attributes = {}, text = "") {
    const child = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
        child.setAttribute(name, value);
    }
    child.textContent = text;
    parent.append(child);
    return child;
}

class Bench {
    constructor(content) {
        this.content = content;
        this.width = content.width;
        this.height = content.height;
        this.renderer = new Renderer(content);
        this.names = [...Object.keys(content.tables), OWN];
        this.technique = "ltsh4" in content.tables ? "ltsh4" : this.names[0];
        this.showsError = false;
        this.busyUntil = 0; // while one drags, and a little longer, only the stage is drawn
        this.isDragging = false;
        this.times = new Map(); // ms of a small picture, by technique
        this.ownError = null;
        this.makeScenes();
        this.makeControls();
        this.makeChoices();
        this.makeCards();
        this.makeOwn();
        this.listen();
        for (const name of Object.keys(content.tables)) {
            this.shaderText ??= {};
            this.shaderText[name] = content.shaders[`lobe_${name}`];
        }
        // The picture first: its technique, and what shows it.
        this.renderer.compile(this.technique, this.renderer.techniqueText(this.shaderText[this.technique]));
        this.renderer.compile("display", this.renderer.text("", this.joined("display")));
        this.resetRanks();
        this.choose(0);
    }

    joined(name) {
        return `${this.content.shaders.surface}\n${this.content.shaders[name]}`;
    }

    // What is on the page:

    makeScenes() {
        this.sceneButtons = this.content.scenes.map((scene, index) => {
            const button = created(element("scenes"), "button", { type: "button", "aria-pressed": "false" });
            const canvas = created(button, "canvas", { width: this.width, height: this.height });
            created(button, "span", {}, scene.name);
            const image = new ImageData(this.width, this.height);
            for (let i = 0; i < scene.picture.length; ++i) {
                const value = Math.min(scene.picture[i] * 2 ** scene.exposure, 1);
                const encoded = value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055;
                const row = this.height - 1 - Math.floor(i / 4 / this.width);
                image.data[i % (4 * this.width) + 4 * this.width * row] = i % 4 === 3 ? 255 : Math.round(255 * encoded);
            }
            canvas.getContext("2d").putImageData(image, 0, 0);
            button.addEventListener("click", () => this.choose(index));
            return button;
        });
    }

    makeControls() {
        this.inputs = new Map();
        for (const [group, sliders] of Object.entries(SLIDERS)) {
            const fieldset = created(element("controls"), "fieldset");
            created(fieldset, "legend", {}, group);
            for (const [key, label, min, max, step, unit = ""] of sliders) {
                const line = created(fieldset, "label", { class: "slider" });
                created(line, "span", {}, label);
                const input = created(line, "input", { type: "range", min, max, step, "data-key": key });
                const output = created(line, "output");
                input.addEventListener("input", () => this.change({ [key]: input.valueAsNumber }));
                input.addEventListener("change", () => this.rest());
                this.inputs.set(key, { input, output, unit, digits: step < 0.1 ? 2 : step < 1 ? 1 : 0 });
            }
        }
    }

    makeChoices() {
        const radio = (parent, label, chosen) => {
            const button = created(element(parent), "button", { type: "button", role: "radio" }, label);
            button.addEventListener("click", chosen);
            return button;
        };
        this.techniqueButtons = new Map([...this.names, REFERENCE].map(
            name => [name, radio("techniques", LABELS[name] ?? name, () => this.show(name, this.showsError))]));
        this.viewButtons = ["Picture", "Error"].map(
            (label, index) => radio("views", label, () => this.show(this.technique, index === 1)));
    }

    makeCards() {
        this.cards = new Map([...this.names, REFERENCE].map(name => {
            const button = created(element("cards"), "button", { type: "button", "data-technique": name, class: "stale" });
            const size = { width: this.width, height: this.height };
            const card = { button, picture: created(button, "canvas", size) };
            if (name === REFERENCE) {
                this.makeScale(created(button, "div", { class: "scale" }));
            } else {
                card.error = created(button, "canvas", size);
            }
            const words = created(button, "div", { class: "words" });
            created(words, "b", {}, LABELS[name] ?? name);
            [card.first, card.second, card.third] = [0, 1, 2].map(() => created(words, "span", {}, "–"));
            button.addEventListener("click", () => this.show(name, this.showsError));
            return [name, card];
        }));
    }

    makeScale(parent) {
        created(parent, "div", {}, "error, of white");
        const context = created(parent, "canvas", { width: 128, height: 1 }).getContext("2d");
        const gradient = context.createLinearGradient(0, 0, 128, 0);
        for (const [stop, ...color] of this.content.error_colors) {
            gradient.addColorStop(0.5 + 0.5 * stop, `rgb(${color.map(value => Math.round(255 * value))})`);
        }
        context.fillStyle = gradient;
        context.fillRect(0, 0, 128, 1);
        const labels = created(parent, "div");
        for (const text of [`−${100 * ERROR_SCALE} %`, "0", `+${100 * ERROR_SCALE} %`]) {
            created(labels, "span", {}, text);
        }
    }

    makeOwn() {
        const select = element("presets"), source = element("source");
        for (const [name, label] of Object.entries(PRESETS)) {
            created(select, "option", { value: name }, label);
        }
        const take = () => {
            source.value = this.content.shaders[select.value].trimEnd();
            this.ownChanged = performance.now() - 1000;
            this.wake();
        };
        select.addEventListener("change", take);
        source.addEventListener("input", () => {
            this.ownChanged = performance.now();
            element("own-state").textContent = "";
            this.wake();
        });
        source.addEventListener("keydown", event => event.stopPropagation());
        take();
    }

    // What changes:

    choose(index) {
        this.scene = index;
        const { picture, name, ...state } = this.content.scenes[index];
        this.state = { ...state };
        this.changed();
    }

    /* Other values for some keys of the state, which is then none of the frozen scenes. */
    change(values) {
        this.scene = -1;
        Object.assign(this.state, values);
        this.busyUntil = performance.now() + 200;
        this.changed();
    }

    /* Nothing is being dragged any more. */
    rest() {
        this.busyUntil = 0;
        this.wake();
    }

    show(technique, showsError) {
        this.technique = technique;
        this.showsError = showsError && technique !== REFERENCE;
        this.stageShows = null;
        this.mark();
        this.wake();
    }

    changed() {
        this.results = new Map(); // by technique: pixels, difference
        this.stageShows = null;
        this.points = 0; // of the reference
        this.reference = null; // its pixels
        this.noise = Infinity;
        this.timed = new Set();
        this.changedAt = performance.now();
        for (const [key, { input, output, unit, digits }] of this.inputs) {
            input.value = this.state[key];
            output.textContent = `${this.state[key].toFixed(digits).replace("-", "−")}${unit}`;
        }
        for (const { button } of this.cards.values()) {
            button.classList.add("stale");
        }
        this.mark();
        this.wake();
    }

    mark() {
        for (const [name, button] of this.techniqueButtons) {
            button.setAttribute("aria-checked", name === this.technique);
            this.cards.get(name).button.setAttribute("aria-pressed", name === this.technique);
        }
        this.viewButtons.forEach((button, index) => button.setAttribute("aria-checked", (index === 1) === this.showsError));
        this.sceneButtons.forEach((button, index) => button.setAttribute("aria-pressed", index === this.scene));
        const corners = this.projectedLight();
        element("outline").setAttribute("points", corners.slice(1).map(corner => corner.join(",")).join(" "));
        for (const id of ["halo", "handle"]) {
            element(id).setAttribute("cx", corners[0][0]);
            element(id).setAttribute("cy", corners[0][1]);
        }
    }

    /* Center and corners of the light in the overlay's units. */
    projectedLight() {
        const { center, halfU, halfV } = lightOf(this.state), camera = cameraOf(this.state, this.content.camera);
        const places = [[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]];
        return places.map(([u, v]) => {
            const offset = sum(center, scaled(u, halfU), scaled(v, halfV), scaled(-1, camera.eye));
            const depth = Math.max(dot(offset, camera.forward), 0.05) * camera.tangent;
            const x = dot(offset, camera.right) / depth, y = dot(offset, camera.up) / depth;
            return [800 * (1 + x), 450 * (1 - y * 16 / 9)].map(value => Math.round(Math.min(Math.max(value, -4000), 5600)));
        });
    }

    moveLight(right, up, away = 0) {
        const { right: axis } = cameraOf(this.state, this.content.camera);
        const within = (value, least, most) => Math.min(Math.max(value, least), most);
        this.change({
            x: within(this.state.x + right * axis[0] - away * axis[1], -4, 4),
            y: within(this.state.y + right * axis[1] + away * axis[0], -3, 4),
            z: within(this.state.z + up, 0.02, 4),
        });
    }

    listen() {
        const view = element("view");
        let last = null, isLight = false, before = null;
        view.addEventListener("pointerdown", event => {
            if (event.button !== 0) {
                return;
            }
            isLight = ["halo", "outline"].includes(event.target.id);
            before = { scene: this.scene, state: { ...this.state } };
            last = [event.clientX, event.clientY];
            this.isDragging = true;
            view.setPointerCapture(event.pointerId);
            view.classList.add("dragging");
        });
        view.addEventListener("pointermove", event => {
            if (!this.isDragging || last === null) {
                return;
            }
            const width = view.clientWidth, dx = (event.clientX - last[0]) / width, dy = (event.clientY - last[1]) / width;
            last = [event.clientX, event.clientY];
            if (isLight) {
                const camera = cameraOf(this.state, this.content.camera);
                const offset = sum(lightOf(this.state).center, scaled(-1, camera.eye));
                const size = 2 * camera.tangent * Math.max(dot(offset, camera.forward), 0.5);
                this.moveLight(size * dx, event.shiftKey ? 0 : -size * dy, event.shiftKey ? -2 * size * dy : 0);
            } else {
                const orbit = this.state.orbit - 200 * dx;
                const rise = Math.min(Math.max(this.state.rise + 120 * dy, 2), 80);
                this.change({ orbit: (orbit + 540) % 360 - 180, rise });
            }
        });
        // A finger on the light does not scroll. `touch-action` is not enough: Chromium does not heed it inside of SVG.
        element("overlay").addEventListener("touchstart", event => event.preventDefault(), { passive: false });
        const end = () => {
            if (this.isDragging) {
                this.isDragging = false;
                last = null;
                view.classList.remove("dragging");
                this.rest();
            }
        };
        view.addEventListener("pointerup", end);
        view.addEventListener("pointercancel", () => { // the finger scrolls the page
            if (this.isDragging) {
                Object.assign(this, before);
                this.changed();
                end();
            }
        });
        element("picture").addEventListener("keydown", event => {
            const step = event.shiftKey ? 0.2 : 0.05;
            const moves = {
                ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step],
                PageUp: [0, 0, step], PageDown: [0, 0, -step],
            };
            if (event.key in moves) {
                this.moveLight(...moves[event.key]);
                event.preventDefault();
            }
        });
        addEventListener("keydown", event => {
            if (event.ctrlKey || event.altKey || event.metaKey || ["SELECT", "TEXTAREA"].includes(event.target.tagName)) {
                return;
            }
            const chosen = [...this.names, REFERENCE][Number(event.key) - 1];
            if (chosen) {
                this.show(chosen, this.showsError);
            } else if (event.key.toLowerCase() === "e") {
                this.show(this.technique, !this.showsError);
            }
        });
        this.renderer.canvas.addEventListener("webglcontextlost", () => trouble("The graphics card has stopped; load the page again."));
    }

    // What is drawn when:

    wake() {
        this.frameRequest ??= requestAnimationFrame(() => {
            this.frameRequest = null;
            this.frame();
        });
    }

    frame() {
        const start = performance.now();
        if (this.isDragging || start < this.busyUntil) {
            this.drawStage(true);
            this.frames = [...(this.frames ?? []).slice(-19), Math.round(performance.now() - start)]; // ms of the last ones
            this.frameRequest ?? this.wakeLater();
            return;
        }
        let isFirst = true;
        for (const task of this.tasks()) {
            if (task === NEXT_FRAME) {
                if (isFirst) {
                    continue;
                }
                this.wake();
                return;
            }
            isFirst = false;
            task();
            if (performance.now() - start > FRAME_MS) {
                this.wake();
                return;
            }
        }
        if (this.waits()) {
            this.wake();
        }
    }

    /* Look again when what one drags may have come to rest. */
    wakeLater() {
        clearTimeout(this.later);
        this.later = setTimeout(() => this.wake(), 210);
    }

    waits() {
        return this.ownChanged !== null || this.names.some(name => !this.canDraw(name) && !(name === OWN && this.ownError));
    }

    canDraw(name) {
        return this.renderer.isCompiled(name === REFERENCE ? "reference" : name) && !(name === OWN && this.ownError);
    }

    /* What is to be done, the first things first. */
    * tasks() {
        if (this.stageShows === null && this.technique !== REFERENCE) {
            yield () => this.drawStage(false);
        }
        if (!this.compiled) {
            yield () => this.compileRest();
        }
        if (this.ownChanged !== null && performance.now() > this.ownChanged + 300) {
            yield () => this.compileOwn();
        }
        const drawn = [this.technique, ...this.names].filter(name => name !== REFERENCE);
        for (const name of new Set(drawn)) {
            if (!this.results.has(name) && this.canDraw(name)) {
                yield () => this.drawCard(name);
            }
        }
        if (!this.canDraw(REFERENCE)) {
            return;
        }
        while (this.points < FIRST_POINTS) {
            yield () => this.addPoints();
        }
        yield* this.differences();
        yield NEXT_FRAME; // show all errors before the fine stage
        if (this.results.has(this.technique) && !this.times.has(this.technique)) {
            yield () => this.takeTime(this.technique);
        }
        while (this.stageShows !== "fine" && this.canDraw(this.technique)) {
            yield () => this.drawStage(false, true);
        }
        for (const name of this.names) {
            if (this.results.has(name) && !this.timed.has(name)) {
                yield () => this.takeTime(name);
            }
        }
        while (this.points < MOST_POINTS && !(this.noise < LEAST_NOISE && this.points >= 32 * POINTS)) {
            yield () => this.addPoints();
            yield* this.differences();
        }
        for (const [scene, name] of this.unranked()) {
            yield () => this.rank(scene, name);
        }
        if (!this.webGpu) {
            yield () => this.askWebGpu();
        }
    }

    * differences() {
        for (const [name, result] of this.results) {
            if (result.against !== this.reference && this.reference) {
                yield () => this.compare(name, result);
            }
        }
    }

    compileRest() {
        this.compiled = true;
        this.renderer.compile("surfaces", this.renderer.text("", this.joined("surfaces")));
        this.renderer.compile("reference", this.renderer.text("", this.joined("reference")));
        for (const name of this.names) {
            if (name !== OWN && name !== this.technique) {
                this.renderer.compile(name, this.renderer.techniqueText(this.shaderText[name]));
            }
        }
        element("machine").textContent = `Drawn by ${this.renderer.graphics}, ${this.width} × ${this.height} pixels.`;
    }

    compileOwn() {
        this.ownChanged = null;
        this.ownError = null;
        this.renderer.compile(OWN, this.renderer.techniqueText(element("source").value));
        const complaint = this.renderer.complaint(OWN);
        const errors = element("own-errors"), state = element("own-state");
        this.ownError = complaint && complaint.replace(/ERROR: 0:(\d+): ?/g, "line $1: ").replace(/\0/g, "").trim();
        errors.hidden = !complaint;
        errors.textContent = this.ownError ?? "";
        state.textContent = complaint ? "does not compile" : "compiled";
        state.classList.toggle("bad", Boolean(complaint));
        this.times.delete(OWN);
        this.results.delete(OWN);
        this.timed.delete(OWN);
        this.stageShows = this.technique === OWN ? null : this.stageShows;
        this.forgetRanks(OWN);
        if (complaint) {
            const card = this.cards.get(OWN);
            card.button.classList.add("stale");
            card.first.textContent = card.second.textContent = card.third.textContent = "–";
        }
    }

    /* The picture that is dragged in, as fine as there is time for. */
    drawStage(isMoving, isFine = false) {
        const name = this.technique, canvas = element("picture");
        if (name === REFERENCE || this.showsError) {
            this.drawStageByPoints(isMoving, isFine);
            return;
        }
        if (!this.canDraw(name)) {
            return;
        }
        const one = this.times.get(name) ?? (isMoving ? MOVING_MS : STILL_MS);
        const wanted = Math.ceil(canvas.clientWidth * devicePixelRatio / this.width);
        const affordable = Math.sqrt((isMoving ? MOVING_MS : STILL_MS) / Math.max(one, 0.01));
        const scale = isMoving || isFine ? Math.max(Math.floor(Math.min(affordable, wanted, LARGEST_STAGE)), 1) : 1;
        if (scale === 1) {
            if (!this.results.has(name)) {
                this.drawCard(name);
            }
            const { texture } = this.renderer.target(name, this.width, this.height);
            this.renderer.show(canvas, this.state, texture, this.width, this.height);
        } else {
            const target = this.renderer.target("stage", scale * this.width, scale * this.height);
            if (isMoving) {
                this.learnTime(name, this.renderer.drawTechnique(name, this.state, target) / scale ** 2);
            } else if (!this.drawBand(target, BAND_MS / (one * scale ** 2))) {
                return;
            }
            this.renderer.show(canvas, this.state, target.texture, target.width, target.height);
        }
        this.stageShows = isFine ? "fine" : "coarse";
        this.firstAt ??= performance.now();
        this.tell();
    }

    /* Draw the next rows of the stage, a share of all. Returns whether they were the last ones. */
    drawBand(target, share) {
        if (this.stageShows !== target) {
            [this.stageShows, this.rows] = [target, 0];
        }
        const rows = Math.ceil(target.height * Math.min(share, 1));
        this.renderer.drawTechnique(this.technique, this.state, target, 1, [this.rows, rows]);
        this.rows += rows;
        return this.rows >= target.height;
    }

    /* The stage where it needs the reference: it is shown itself, or an error. */
    drawStageByPoints(isMoving, isFine) {
        if (!this.canDraw(REFERENCE) || (this.showsError && !this.canDraw(this.technique))) {
            return;
        }
        if (this.points === 0) {
            this.addPoints();
        }
        this.showReferenceOnStage();
        this.stageShows = isFine ? "fine" : "coarse";
    }

    showReferenceOnStage() {
        const size = [this.width, this.height], canvas = element("picture"), reference = this.referenceTexture();
        if (this.showsError) {
            if (!this.results.has(this.technique)) {
                this.drawCard(this.technique);
            }
            const { texture } = this.renderer.target(this.technique, ...size);
            this.renderer.show(canvas, this.state, texture, ...size, reference, ERROR_SCALE);
        } else {
            this.renderer.show(canvas, this.state, reference, ...size);
        }
        this.tell();
    }

    referenceTexture() {
        return this.scene >= 0 ? this.renderer.frozenTexture(this.scene) : this.referenceTarget.texture;
    }

    drawCard(name) {
        const target = this.renderer.target(name, this.width, this.height);
        const took = this.renderer.drawTechnique(name, this.state, target);
        this.results.set(name, { pixels: this.isDragging ? null : this.renderer.read(target), against: null, difference: null });
        if (this.timesKnown?.has(name)) { // the first draw also finishes the shader
            this.learnTime(name, took);
        }
        (this.timesKnown ??= new Set()).add(name);
        if (this.isDragging) {
            return;
        }
        const card = this.cards.get(name);
        this.renderer.show(card.picture, this.state, target.texture, this.width, this.height);
        card.button.classList.remove("stale");
    }

    /* Short draws are timed as many at once. */
    takeTime(name) {
        this.timed.add(name);
        const known = this.times.get(name);
        if (known === undefined || known < 4) {
            const target = this.renderer.target(name, this.width, this.height);
            this.learnTime(name, this.renderer.drawTechnique(name, this.state, target, known === undefined ? 1 : 16));
        }
    }

    /* The least time counts: others had to wait for something else. */
    learnTime(name, took) {
        this.times.set(name, Math.min(this.times.get(name) ?? took, took));
        this.cards.get(name).first.textContent = milliseconds(this.times.get(name));
        this.tell();
    }

    /* More points for the reference. Frozen scenes have theirs. */
    addPoints() {
        const card = this.cards.get(REFERENCE), isFrozen = this.scene >= 0;
        if (isFrozen) {
            this.points = MOST_POINTS;
            this.reference = this.content.scenes[this.scene].picture;
            [card.first, card.second, card.third].forEach((line, i) => { line.textContent = ["numpy", "quadrature", ""][i]; });
        } else {
            const start = performance.now();
            this.referenceTarget = this.renderer.drawReference(this.state, this.points, POINTS, this.width, this.height);
            this.points += POINTS;
            card.first.textContent = milliseconds(performance.now() - start);
            card.third.textContent = `${this.points}`;
            // To read it costs time, and twice as many points tell little news.
            if (this.isDragging || Math.log2(this.points / POINTS) % 1 !== 0) {
                return;
            }
            this.reference = this.renderer.read(this.referenceTarget);
            this.noise = difference(this.reference, this.reference, this.points / POINTS).noise;
            card.second.textContent = this.points > POINTS ? `noise ${percent(this.noise)}` : "";
        }
        this.renderer.show(card.picture, this.state, this.referenceTexture(), this.width, this.height);
        card.button.classList.remove("stale");
        if (this.technique === REFERENCE || this.showsError) {
            this.showReferenceOnStage();
        }
    }

    compare(name, result) {
        const card = this.cards.get(name), target = this.renderer.target(name, this.width, this.height);
        result.pixels ??= this.renderer.read(target);
        result.difference = difference(result.pixels, this.reference);
        result.against = this.reference;
        const { error, bias } = result.difference;
        this.renderer.show(card.error, this.state, target.texture, this.width, this.height, this.referenceTexture(), ERROR_SCALE);
        card.second.textContent = `error ${percent(error)}`;
        card.third.textContent = `${bias < 0 ? "−" : "+"}${percent(Math.abs(bias))}`;
        card.third.title = "mean error";
        this.tell();
    }

    /* The line in the corner of the stage. */
    tell() {
        const name = this.technique, words = [LABELS[name] ?? name], result = this.results.get(name);
        if (name === REFERENCE) {
            words.push(this.scene >= 0 ? "numpy" : `${this.points} points`);
        } else if (this.times.has(name)) {
            words.push(milliseconds(this.times.get(name)));
        }
        if (result?.difference) {
            words.push(`error ${percent(result.difference.error)}`);
        }
        element("corner").textContent = words.join("  ·  ");
    }

    // The table of ranks:

    resetRanks() {
        this.errors = new Map(this.names.map(name => [name, new Array(this.content.scenes.length).fill(null)]));
        this.drawRanks();
    }

    forgetRanks(name) {
        this.errors.get(name).fill(null);
        this.drawRanks();
    }

    * unranked() {
        for (let scene = 0; scene < this.content.scenes.length; ++scene) {
            for (const name of this.names) {
                if (this.errors.get(name)[scene] === null && this.canDraw(name)) {
                    yield [scene, name];
                }
            }
        }
    }

    rank(scene, name) {
        const target = this.renderer.target("rank", this.width, this.height);
        const took = this.renderer.drawTechnique(name, this.content.scenes[scene], target);
        this.learnTime(name, took);
        this.errors.get(name)[scene] = difference(this.renderer.read(target), this.content.scenes[scene].picture).error;
        this.drawRanks();
    }

    /* The techniques by WebGPU in the first frozen scene: time, and the largest difference from WebGL in 255ths. */
    async askWebGpu() {
        this.webGpu = new Map();
        const scene = this.content.scenes[0], size = [this.width, this.height];
        const shown = value => 255 * Math.min(value * 2 ** scene.exposure, 1) ** (1 / 2.2);
        try {
            const webGpu = await WebGpu.make(this.renderer);
            for (const name of webGpu ? Object.keys(this.content.tables) : []) {
                const { pixels, took } = await webGpu.draw(name, scene, ...size);
                const target = this.renderer.target("rank", ...size);
                this.renderer.drawTechnique(name, scene, target);
                const off = this.renderer.read(target).reduce(
                    (most, value, i) => i % 4 < 3 ? Math.max(most, Math.abs(shown(value) - shown(pixels[i]))) : most, 0);
                this.webGpu.set(name, { took, off });
                this.drawRanks();
            }
        } catch (error) {
            element("machine").textContent += ` WebGPU: ${error.message}`;
        }
    }

    drawRanks() {
        const mean = values => values.reduce((total, value) => total + value, 0) / values.length;
        const median = values => {
            const sorted = [...values].sort((a, b) => a - b);
            return mean(sorted.slice(sorted.length - 1 >> 1, (sorted.length >> 1) + 1));
        };
        const rows = this.names.map(name => {
            const errors = this.errors.get(name).filter(error => error !== null);
            const whole = errors.length === this.content.scenes.length;
            return { name, errors, median: whole ? median(errors) : Infinity, worst: whole ? Math.max(...errors) : Infinity };
        });
        rows.sort((a, b) => a.median - b.median);
        const table = element("table");
        table.textContent = "";
        const byGpu = this.webGpu?.size ? ["WebGPU"] : [];
        const head = created(created(table, "thead"), "tr"), body = created(table, "tbody");
        for (const label of ["", "technique", "median", "worst", "best in", "time", ...byGpu, "table"]) {
            created(head, "th", {}, label);
        }
        const best = this.content.scenes.map(
            (_, scene) => Math.min(...this.names.map(name => this.errors.get(name)[scene] ?? Infinity)));
        rows.forEach((row, index) => {
            const line = created(body, "tr"), done = row.median < Infinity;
            const wins = this.errors.get(row.name).filter((error, scene) => error !== null && error === best[scene]).length;
            const size = 2 * this.content.tables[row.name]?.count;
            created(line, "td", {}, done ? `${index + 1}` : "");
            created(line, "td", {}, LABELS[row.name] ?? row.name);
            created(line, "td", {}, done ? percent(row.median) : row.errors.length ? `${row.errors.length} of 10` : "–");
            created(line, "td", {}, done ? percent(row.worst) : "");
            created(line, "td", {}, done ? `${wins}` : "");
            created(line, "td", {}, done && this.times.has(row.name) ? milliseconds(this.times.get(row.name)) : "");
            for (const _ of byGpu) {
                const { took, off } = this.webGpu.get(row.name) ?? {};
                const title = took ? `${off.toFixed(2)} of 255 beside WebGL at most` : "";
                created(line, "td", { title }, took ? `${milliseconds(took)}${off < 1 ? "" : ", differs"}` : "");
            }
            created(line, "td", {}, size ? `${Math.round(size / 1000)} kB` : "–");
        });
    }
}

function trouble(text) {
    element("trouble").hidden = false;
    element("trouble").textContent = text;
}

readPayload(element("payload").textContent).then(content => {
    window.bench = new Bench(content);
}).catch(error => {
    trouble(error.message);
    throw error;
});
