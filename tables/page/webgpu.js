/* The techniques once more, by WebGPU, where a browser has it: the exported WGSL as compute shaders. */
class WebGpu {
    /* Null where there is none. Browsers offer WebGPU to pages on this disk and from https. */
    static async make(renderer) {
        const adapter = await navigator.gpu?.requestAdapter();
        return adapter ? new WebGpu(renderer, await adapter.requestDevice()) : null;
    }

    constructor(renderer, device) {
        this.renderer = renderer;
        this.device = device;
    }

    buffer(data, usage) {
        const buffer = this.device.createBuffer({ size: data.byteLength, usage: usage | GPUBufferUsage.COPY_DST });
        this.device.queue.writeBuffer(buffer, 0, data);
        return buffer;
    }

    /* The surfaces that WebGL sees, as `surfaces.glsl` draws them. */
    surfaces(state, width, height) {
        const pixels = 4 * width * height, all = new Float32Array(4 * pixels), target = this.renderer.target("layer", width, height);
        for (let layer = 0; layer < 4; ++layer) {
            const uniforms = this.renderer.use("surfaces");
            this.renderer.setState(uniforms, state, width, height);
            uniforms.set("layer", "1i", layer);
            this.renderer.draw(target.framebuffer, width, height);
            all.set(this.renderer.read(target), layer * pixels);
        }
        return all;
    }

    /* The pixels of a technique's picture, as `Renderer.read` gives them, and how long it takes in ms. */
    async draw(name, state, width, height) {
        const { device, renderer } = this, storage = GPUBufferUsage.STORAGE, size = 16 * width * height;
        const module = device.createShaderModule({ code: renderer.content.shaders[`wgsl_${name}`] });
        const pipeline = await device.createComputePipelineAsync({ layout: "auto", compute: { module } });
        const light = lightOf(state), { eye } = cameraOf(state, renderer.content.camera);
        const scene = new Float32Array([eye, light.center, light.halfU, light.halfV].flatMap(vector => [...vector, 0]));
        const picture = device.createBuffer({ size, usage: storage | GPUBufferUsage.COPY_SRC });
        const copy = device.createBuffer({ size, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
        const buffers = [
            this.buffer(Float32Array.from(renderer.content.tables[name].bits, floatOf), storage),
            this.buffer(this.surfaces(state, width, height), storage), this.buffer(scene, GPUBufferUsage.UNIFORM), picture,
        ];
        const entries = buffers.map((buffer, binding) => ({ binding, resource: { buffer } }));
        const group = device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
        const time = async repeats => {
            const start = performance.now(), encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
            pass.setPipeline(pipeline);
            pass.setBindGroup(0, group);
            for (let i = 0; i < repeats; ++i) {
                pass.dispatchWorkgroups(Math.ceil(width * height / 64));
            }
            pass.end();
            device.queue.submit([encoder.finish()]);
            await device.queue.onSubmittedWorkDone();
            return (performance.now() - start) / repeats;
        };
        await time(1); // the first also finishes the shader
        const once = Math.min(await time(1), await time(1)), took = once < 4 ? await time(16) : once;
        const encoder = device.createCommandEncoder();
        encoder.copyBufferToBuffer(picture, 0, copy, 0, size);
        device.queue.submit([encoder.finish()]);
        await copy.mapAsync(GPUMapMode.READ);
        const pixels = new Float32Array(copy.getMappedRange().slice(0));
        [...buffers, copy].forEach(buffer => buffer.destroy());
        return { pixels, took };
    }
}
