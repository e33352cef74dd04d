//! The score of a device: single-precision throughput of a tiled matrix product, in GFLOP/s (thesis 5.4.1).

use std::time::{Duration, Instant};

use super::{adapter::Gpu, scope::Refusal};

/// The product of two `n` x `n` matrices; a workgroup makes a tile of 64 x 64, an invocation 4 x 4 of it.
const PRODUCT: &str = include_str!("score.wgsl");
/// Edge of the smallest and the largest product. 4096 is 137 GFLOP and 192 MiB.
const EDGES: [u32; 5] = [256, 512, 1_024, 2_048, 4_096];
const TILE_EDGE: u32 = 64;
/// Time after which no further product is begun. lavapipe does the smallest one in some 20 ms.
const BUDGET: Duration = Duration::from_millis(600);
/// A product of this time is long enough to be believed; smaller ones only warm up.
const LONG_ENOUGH: Duration = Duration::from_millis(20);
/// Most time for one product: a device that needs longer answers nothing.
const LIMIT: Duration = Duration::from_secs(30);

/// Measures the device; the first product, which compiles and warms up, does not count.
pub(crate) fn measure(gpu: &Gpu) -> Result<f64, String> {
    let begin = Instant::now();
    let refused = |refusal: Refusal| format!("score: {refusal:?}");
    let pipeline = gpu.scoped(|| pipeline(gpu)).map_err(refused)?;
    let mut best = 0.0_f64;
    for edge in EDGES {
        let bytes = u64::from(edge) * u64::from(edge) * 4;
        if bytes > gpu.binding_bytes() {
            break;
        }
        let bind_group = gpu.scoped(|| bind(gpu, &pipeline, edge)).map_err(refused)?;
        time(gpu, &pipeline, &bind_group, edge)?;
        let mut shortest = Duration::MAX;
        for _ in 0..3 {
            shortest = shortest.min(time(gpu, &pipeline, &bind_group, edge)?);
            if begin.elapsed() > BUDGET {
                break;
            }
        }
        let flop = 2.0 * f64::from(edge).powi(3);
        best = best.max(flop / shortest.as_secs_f64().max(1e-9) / 1e9);
        // The next one is eight times the work, twice.
        let next = shortest.saturating_mul(16);
        if shortest > LONG_ENOUGH || begin.elapsed() + next > BUDGET {
            break;
        }
    }
    Ok(best)
}

fn pipeline(gpu: &Gpu) -> wgpu::ComputePipeline {
    let source = wgpu::ShaderSource::Wgsl(PRODUCT.into());
    let module =
        gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some("score.wgsl"), source });
    gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("score"),
        layout: None,
        module: &module,
        entry_point: Some("product"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}

fn bind(gpu: &Gpu, pipeline: &wgpu::ComputePipeline, edge: u32) -> wgpu::BindGroup {
    let matrix = || {
        gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("score"),
            size: u64::from(edge) * u64::from(edge) * 4,
            usage: wgpu::BufferUsages::STORAGE,
            mapped_at_creation: false,
        })
    };
    let matrices = [matrix(), matrix(), matrix()];
    let entries: Vec<_> = (0..)
        .zip(&matrices)
        .map(|(binding, matrix)| wgpu::BindGroupEntry { binding, resource: matrix.as_entire_binding() })
        .collect();
    let layout = pipeline.get_bind_group_layout(0);
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("score"),
        layout: &layout,
        entries: &entries,
    })
}

fn time(
    gpu: &Gpu,
    pipeline: &wgpu::ComputePipeline,
    bind_group: &wgpu::BindGroup,
    edge: u32,
) -> Result<Duration, String> {
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
    pass.set_pipeline(pipeline);
    pass.set_bind_group(0, bind_group, &[]);
    pass.dispatch_workgroups(edge / TILE_EDGE, edge / TILE_EDGE, 1);
    drop(pass);
    let commands = encoder.finish();
    let begin = Instant::now();
    let index = gpu.queue.submit([commands]);
    let poll = wgpu::PollType::Wait { submission_index: Some(index), timeout: Some(LIMIT) };
    gpu.device.poll(poll).map_err(|error| format!("score: product of {edge} x {edge}: {error}"))?;
    Ok(begin.elapsed())
}
