// Draws a decoded scene, and lines and surface over it.
function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k += 1) {
    const { name } = gl.getActiveUniform(made, k);
    places[name] = gl.getUniformLocation(made, name);
  }
  return { made, places };
}

class Renderer {
  constructor(canvas, shaders) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.canvas = canvas;
    // Sums of many faint layers need more than eight bits.
    this.half = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.splats = program(gl, shaders["splat.vert"], shaders["splat.frag"]);
    this.screen = program(gl, shaders["screen.vert"], shaders["screen.frag"]);
    this.shape = program(gl, shaders["shape.vert"], shaders["shape.frag"]);
    this.order = gl.createBuffer();
    this.splatArray = gl.createVertexArray();
    gl.bindVertexArray(this.splatArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    this.empty = gl.createVertexArray();
    this.target = gl.createFramebuffer();
    this.image = gl.createTexture();
    this.count = 0;
    this.size = [0, 0];
  }

  table(data, format, internal, type) {
    const gl = this.gl, texels = data.length / 4;
    const width = Math.min(2048, Math.max(1, texels)), height = Math.max(1, Math.ceil(texels / width));
    const padded = new data.constructor(4 * width * height);
    padded.set(data);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, padded);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  upload(scene) {
    const gl = this.gl;
    scene.textures = {
      geometry: this.table(scene.geometry, gl.RGBA, gl.RGBA32F, gl.FLOAT),
      harmonics: this.table(scene.harmonics, gl.RGBA, gl.RGBA16F, gl.FLOAT),
      quantities: this.table(scene.quantities, gl.RGBA, gl.RGBA8, gl.UNSIGNED_BYTE),
    };
    scene.geometry = scene.harmonics = scene.quantities = null;
  }

  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.count = order.length;
  }

  resize() {
    const { gl, canvas } = this;
    if (this.size[0] === canvas.width && this.size[1] === canvas.height) return;
    this.size = [canvas.width, canvas.height];
    gl.deleteTexture(this.image);
    this.image = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.half ? gl.RGBA16F : gl.RGBA8, ...this.size);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }

  drawSplats(scene, state) {
    const gl = this.gl, { made, places } = this.splats;
    this.resize();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, ...this.size);
    gl.disable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(made);
    ["geometry", "harmonics", "quantities"].forEach((name, unitIndex) => {
      gl.activeTexture(gl.TEXTURE0 + unitIndex);
      gl.bindTexture(gl.TEXTURE_2D, scene.textures[name]);
      gl.uniform1i(places[name], unitIndex);
    });
    gl.activeTexture(gl.TEXTURE0);
    const light = state.light;
    gl.uniform1i(places.terms, scene.terms);
    gl.uniformMatrix4fv(places.view, false, state.view);
    gl.uniformMatrix4fv(places.lamp, false, state.lamp);
    gl.uniform3fv(places.eye, state.eye);
    gl.uniform4fv(places.K, state.K);
    gl.uniform2fv(places.size, this.size);
    gl.uniform1f(places.dilation, state.dilation);
    gl.uniform1f(places.near, state.near);
    gl.uniform1i(places.lit, light.on ? 1 : 0);
    gl.uniform1f(places.exposure, light.exposure);
    gl.uniform4f(places.falloff, light.softening, light.exponent, light.spread, light.cosine);
    gl.uniform4f(places.place, ...light.offset, light.reference);
    gl.uniform3fv(places.home, light.home);
    gl.uniform1f(places.shoulder, light.shoulder);
    gl.uniform2f(places.gloss, light.specular, light.roughness);
    gl.uniform3fv(places.glare, light.glare);
    gl.uniform1i(places.shade, state.shade);
    gl.bindVertexArray(this.splatArray);
    if (this.count) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.screen.made);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.uniform1i(this.screen.places.image, 0);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  makeShape(positions, tints, mode) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    [positions, tints].forEach((data, place) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
    });
    return { array, mode, count: positions.length / 3 };
  }

  drawShape(shape, state, strength) {
    const gl = this.gl, { made, places } = this.shape, surface = shape.mode === gl.TRIANGLES;
    gl.useProgram(made);
    gl.uniformMatrix4fv(places.view, false, state.view);
    gl.uniform4fv(places.K, state.K);
    gl.uniform2fv(places.size, this.size);
    gl.uniform1f(places.near, state.near);
    gl.uniform1f(places.far, state.far);
    gl.uniform1i(places.surface, surface ? 1 : 0);
    gl.uniform1f(places.strength, strength);
    gl.bindVertexArray(shape.array);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (surface) {
      // Depth first, so that only the nearest sheet shows through.
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.depthFunc(gl.LEQUAL);
      gl.colorMask(false, false, false, false);
      gl.drawArrays(shape.mode, 0, shape.count);
      gl.colorMask(true, true, true, true);
    }
    gl.drawArrays(shape.mode, 0, shape.count);
    gl.disable(gl.DEPTH_TEST);
  }
}
