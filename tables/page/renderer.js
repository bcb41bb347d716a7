"use strict";
/* Draws the scene by WebGL 2: every technique, the reference, and what of it is shown. Knows nothing of the page. */

/* The text, the tables (half floats as bits) and the reference pictures (RGBA floats, rows from below) of the page. */
async function readPayload(text) {
    const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const all = new Uint8Array(await new Response(stream).arrayBuffer());
    const length = new DataView(all.buffer).getUint32(0, true);
    const content = JSON.parse(new TextDecoder().decode(all.subarray(4, 4 + length)));
    let at = 4 + length + length % 2;
    const nextHalves = count => {
        const bits = new Uint16Array(count);
        for (let i = 0; i < count; ++i) {
            bits[i] = all[at + i] << 8 | all[at + count + i];
        }
        at += 2 * count;
        return bits;
    };
    for (const table of Object.values(content.tables)) {
        table.bits = nextHalves(table.count);
    }
    const pixels = content.width * content.height;
    for (const scene of content.scenes) {
        const bits = nextHalves(3 * pixels);
        scene.picture = new Float32Array(4 * pixels).fill(1);
        for (let i = 1; i < bits.length; ++i) {
            bits[i] += bits[i - 1];
        }
        for (let i = 0; i < bits.length; ++i) {
            const channel = Math.floor(i / pixels), place = i % pixels;
            const x = place % content.width, y = content.height - 1 - Math.floor(place / content.width);
            scene.picture[4 * (y * content.width + x) + channel] = floatOf(bits[i]);
        }
    }
    return content;
}

/* The value of the bits of a half float that is not infinite. */
function floatOf(bits) {
    const exponent = bits >> 10 & 31, fraction = bits & 1023;
    const size = exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24;
    return bits >> 15 ? -size : size;
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (factor, v) => v.map(value => factor * value);
const sum = (...vectors) => vectors[0].map((_, i) => vectors.reduce((total, v) => total + v[i], 0));
const radians = degrees => degrees * Math.PI / 180;

/* Half sides and direction of the light of a state, see `BenchScene.light` in tables/bench.py. */
function lightOf(state) {
    const turn = radians(state.turn), tilt = radians(state.tilt);
    const direction = [Math.sin(turn) * Math.cos(tilt), -Math.cos(turn) * Math.cos(tilt), -Math.sin(tilt)];
    const along = [Math.cos(turn), Math.sin(turn), 0];
    return {
        center: [state.x, state.y, state.z],
        halfU: scaled(0.5 * state.width, along),
        halfV: scaled(0.5 * state.height, cross(direction, along)),
    };
}

/* Eye and axes of the camera of a state, see `camera_of` in tables/bench.py. */
function cameraOf(state, { target, distance, tangent }) {
    const orbit = radians(state.orbit), rise = radians(state.rise);
    const forward = [Math.sin(orbit) * Math.cos(rise), Math.cos(orbit) * Math.cos(rise), -Math.sin(rise)];
    const right = [Math.cos(orbit), -Math.sin(orbit), 0], up = cross(right, forward);
    return { eye: sum(target, scaled(-distance, forward)), right, up, forward, tangent };
}

class Renderer {
    constructor(content) {
        this.content = content;
        this.canvas = document.createElement("canvas");
        const gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
        if (!gl) {
            throw new Error("This page needs WebGL 2, which this browser does not offer.");
        }
        this.gl = gl;
        this.isFloat = Boolean(gl.getExtension("EXT_color_buffer_float"));
        if (!this.isFloat && !gl.getExtension("EXT_color_buffer_half_float")) {
            throw new Error("This page needs WebGL 2 that draws into float textures (EXT_color_buffer_float).");
        }
        this.parallel = gl.getExtension("KHR_parallel_shader_compile");
        this.programs = new Map();
        this.targets = new Map();
        this.textures = new Map();
        gl.bindVertexArray(gl.createVertexArray());
        this.vertexShader = this.shader(gl.VERTEX_SHADER, `#version 300 es
            void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }`);
    }

    get graphics() {
        const info = this.gl.getExtension("WEBGL_debug_renderer_info");
        return this.gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : this.gl.RENDERER);
    }

    shader(kind, text) {
        const shader = this.gl.createShader(kind);
        this.gl.shaderSource(shader, text);
        this.gl.compileShader(shader);
        return shader;
    }

    /* The shader of a technique: the headers of the tables that `shade` names, the scene, `shade`, and what calls it. */
    techniqueText(shade) {
        return this.text(shade, `${this.content.shaders.surface}\n#line 1\n${shade}\n${this.content.shaders.technique}`);
    }

    text(names, body) {
        const used = Object.keys(this.content.tables).filter(name => new RegExp(`\\b${name}_`).test(names));
        const headers = (used.length ? used : ["ltc"]).map(name => {
            const width = this.content.texture_width, at = `ivec2((index) % ${width}, (index) / ${width})`;
            return `uniform sampler2D ${name}_table;
#define ${name.toUpperCase()}_DATA(index) texelFetch(${name}_table, ${at}, 0).r
${this.content.tables[name].header}`;
        });
        const precision = ["float", "int", "sampler2D"].map(kind => `precision highp ${kind};\n`).join("");
        return `#version 300 es\n${precision}${headers.join("\n")}\n${body}`;
    }

    /* Begin to compile a program; `ready` tells when it is done. */
    compile(name, fragmentText) {
        const gl = this.gl, program = gl.createProgram();
        const fragment = this.shader(gl.FRAGMENT_SHADER, fragmentText);
        gl.attachShader(program, this.vertexShader);
        gl.attachShader(program, fragment);
        gl.linkProgram(program);
        this.programs.set(name, { program, fragment, uniforms: null });
    }

    /* Whether a program can be asked for without waiting. */
    isCompiled(name) {
        const entry = this.programs.get(name);
        return entry && (entry.uniforms !== null || !this.parallel
            || this.gl.getProgramParameter(entry.program, this.parallel.COMPLETION_STATUS_KHR));
    }

    /* What the compiler says against a program; null if nothing. Waits for it. */
    complaint(name) {
        const gl = this.gl, { program, fragment } = this.programs.get(name);
        if (gl.getProgramParameter(program, gl.LINK_STATUS)) {
            return null;
        }
        return gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program) || "The shader cannot be linked.";
    }

    use(name) {
        const gl = this.gl, entry = this.programs.get(name);
        if (entry.uniforms === null) {
            const complaint = this.complaint(name);
            if (complaint) {
                throw new Error(`${name}: ${complaint}`);
            }
            entry.uniforms = new Map();
            const count = gl.getProgramParameter(entry.program, gl.ACTIVE_UNIFORMS);
            for (let i = 0; i < count; ++i) {
                const uniform = gl.getActiveUniform(entry.program, i);
                entry.uniforms.set(uniform.name, gl.getUniformLocation(entry.program, uniform.name));
            }
        }
        gl.useProgram(entry.program);
        let unit = 0;
        for (const table of Object.keys(this.content.tables)) {
            if (entry.uniforms.has(`${table}_table`)) {
                const texture = this.tableTexture(table);
                gl.activeTexture(gl.TEXTURE0 + unit);
                gl.bindTexture(gl.TEXTURE_2D, texture);
                gl.uniform1i(entry.uniforms.get(`${table}_table`), unit++);
            }
        }
        const set = (uniform, kind, ...values) => {
            if (entry.uniforms.has(uniform)) {
                gl[`uniform${kind}`](entry.uniforms.get(uniform), ...values);
            }
        };
        const setTexture = (uniform, texture) => {
            if (entry.uniforms.has(uniform)) {
                gl.activeTexture(gl.TEXTURE0 + unit);
                gl.bindTexture(gl.TEXTURE_2D, texture);
                set(uniform, "1i", unit++);
            }
        };
        return { set, setTexture };
    }

    setState({ set }, state, width, height) {
        const light = lightOf(state), camera = cameraOf(state, this.content.camera);
        const columns = [scaled(camera.tangent, camera.right), scaled(camera.tangent * 9 / 16, camera.up), camera.forward];
        set("eye", "3fv", camera.eye);
        set("camera", "Matrix3fv", false, columns.flat());
        set("resolution", "2f", width, height);
        set("light_center", "3fv", light.center);
        set("light_half_u", "3fv", light.halfU);
        set("light_half_v", "3fv", light.halfV);
        set("look", "4f", state.roughness, state.metal, state.anisotropy, state.floor);
        set("radiance", "1f", this.content.radiance);
    }

    texture(internal, width, height, format, type, data) {
        const gl = this.gl, texture = gl.createTexture();
        gl.activeTexture(gl.TEXTURE15); // no program looks there
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
        for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
            gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
        }
        return texture;
    }

    tableTexture(name) {
        if (!this.textures.has(name)) {
            const gl = this.gl, bits = this.content.tables[name].bits, width = this.content.texture_width;
            this.textures.set(name, this.texture(gl.R16F, width, bits.length / width, gl.RED, gl.HALF_FLOAT, bits));
        }
        return this.textures.get(name);
    }

    /* The reference picture of a frozen scene. */
    frozenTexture(index) {
        const key = `frozen ${index}`, gl = this.gl, { width, height, scenes } = this.content;
        if (!this.textures.has(key)) {
            const data = scenes[index].picture;
            this.textures.set(key, this.texture(gl.RGBA32F, width, height, gl.RGBA, gl.FLOAT, data));
        }
        return this.textures.get(key);
    }

    /* A picture of floats to draw into, of that size, by name. */
    target(name, width, height) {
        const gl = this.gl;
        let target = this.targets.get(name);
        if (!target || target.width !== width || target.height !== height) {
            if (target) {
                gl.deleteTexture(target.texture);
                gl.deleteFramebuffer(target.framebuffer);
            }
            const [internal, type] = this.isFloat ? [gl.RGBA32F, gl.FLOAT] : [gl.RGBA16F, gl.HALF_FLOAT];
            target = { texture: this.texture(internal, width, height, gl.RGBA, type, null), width, height };
            target.framebuffer = gl.createFramebuffer();
            gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
            gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
            this.targets.set(name, target);
        }
        return target;
    }

    draw(framebuffer, width, height) {
        this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, framebuffer);
        this.gl.viewport(0, 0, width, height);
        this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
    }

    /* Draw a technique (or the program of that name) into a target, or into [first row, rows] of it. Returns the time in
       ms of one draw of `repeats`. */
    drawTechnique(program, state, target, repeats = 1, [firstRow, rows] = [0, target.height]) {
        const start = performance.now(), gl = this.gl;
        this.setState(this.use(program), state, target.width, target.height);
        gl.enable(gl.SCISSOR_TEST);
        gl.scissor(0, firstRow, target.width, rows);
        for (let i = 0; i < repeats; ++i) {
            this.draw(target.framebuffer, target.width, target.height);
        }
        gl.disable(gl.SCISSOR_TEST);
        this.finish();
        return (performance.now() - start) / repeats;
    }

    /* Wait until all is drawn: reading a pixel does, where gl.finish() may not. */
    finish() {
        this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.FLOAT, this.onePixel ??= new Float32Array(4));
    }

    /* Add `count` points to the mean of `first` earlier ones. Returns the target with the mean. */
    drawReference(state, first, count, width, height) {
        const [before, target] = (first / count) % 2 ? ["sums 0", "sums 1"] : ["sums 1", "sums 0"];
        const result = this.target(target, width, height), earlier = this.target(before, width, height);
        const uniforms = this.use("reference");
        this.setState(uniforms, state, width, height);
        uniforms.set("first", "1i", first);
        uniforms.set("count", "1i", count);
        uniforms.setTexture("sums", earlier.texture);
        this.draw(result.framebuffer, width, height);
        this.finish();
        return result;
    }

    /* All pixels of a target, RGBA, rows from below. */
    read(target) {
        const pixels = new Float32Array(4 * target.width * target.height), gl = this.gl;
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
        gl.readPixels(0, 0, target.width, target.height, gl.RGBA, gl.FLOAT, pixels);
        return pixels;
    }

    /* Show a picture, or what it is off `other`, on a 2D canvas, which gets the size `width` x `height`. */
    show(canvas, state, picture, width, height, other = null, errorScale = 1) {
        if (this.canvas.width < width || this.canvas.height < height) {
            this.canvas.width = Math.max(this.canvas.width, width);
            this.canvas.height = Math.max(this.canvas.height, height);
        }
        const uniforms = this.use("display");
        this.setState(uniforms, state, width, height);
        uniforms.setTexture("picture", picture);
        uniforms.setTexture("other", other ?? picture);
        uniforms.set("is_error", "1i", other ? 1 : 0);
        uniforms.set("exposure", "1f", 2 ** state.exposure);
        uniforms.set("error_scale", "1f", errorScale);
        this.draw(null, width, height);
        if (canvas.width !== width || canvas.height !== height) {
            canvas.width = width;
            canvas.height = height;
        }
        canvas.getContext("2d").drawImage(this.canvas, 0, this.canvas.height - height, width, height, 0, 0, width, height);
    }
}

/* How far a picture is from a reference, both RGBA with rows from below: root mean square of the difference and mean of
   it, as shares of the reference's; `noise`, the same for the reference by itself, from `draws` draws. */
function difference(pixels, reference, draws = 0) {
    let squares = 0, all = 0, bias = 0, mean = 0, variance = 0;
    for (let i = 0; i < pixels.length; i += 4) {
        if (pixels[i + 3] < 0) {
            continue;
        }
        for (let k = 0; k < 3; ++k) {
            const off = pixels[i + k] - reference[i + k];
            squares += off * off;
            all += reference[i + k] ** 2;
            bias += off;
            mean += reference[i + k];
        }
        if (draws > 1) {
            const luminance = 0.2126 * reference[i] + 0.7152 * reference[i + 1] + 0.0722 * reference[i + 2];
            variance += Math.max(reference[i + 3] - luminance ** 2, 0) / (draws - 1);
        }
    }
    all = Math.max(all, 1e-30);
    return {
        error: Math.sqrt(squares / all), bias: bias / Math.max(mean, 1e-30), noise: Math.sqrt(3 * variance / all),
    };
}
