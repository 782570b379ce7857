//! The speed of this machine, in fuel units: a vehicle converts the fuel that a lambda states to
//! CPU time by it.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use wasmtime::{Instance, Module, Store};

use super::{CompileError, GUEST_STACK_BYTES, Nans, engine};

/// CPU time of the measurement, without compiling.
const TIME: Duration = Duration::from_millis(200);
/// Iterations of the loop in one call: some 10 ms.
const ITERATIONS: i32 = 1_000_000;

/// A module whose function `run(n)` repeats arithmetic with integers and fractions, a load, a store
/// and a branch `n` times, as loops over samples do.
const LOOP: &[u8] = &[
    0x00, 0x61, 0x73, 0x6d, 0x01, 0x00, 0x00, 0x00, // magic, version
    0x01, 0x06, 0x01, 0x60, 0x01, 0x7f, 0x01, 0x7f, // type 0: (i32) -> i32
    0x03, 0x02, 0x01, 0x00, // function 0 of type 0
    0x05, 0x03, 0x01, 0x00, 0x01, // one memory of one page
    0x07, 0x07, 0x01, 0x03, 0x72, 0x75, 0x6e, 0x00, 0x00, // export "run"
    0x0a, 0x54, 0x01, 0x52, // code of function 0
    0x03, 0x01, 0x7f, 0x01, 0x7c, 0x01, 0x7f, // locals: x: i32, sum: f64, address: i32
    0x03, 0x40, // loop
    0x20, 0x01, 0x41, 0x8d, 0xcc, 0xe5, 0x00, 0x6c, // x * 1664525
    0x41, 0xdf, 0xe6, 0xbb, 0xe3, 0x03, 0x6a, 0x22, 0x01, // + 1013904223 = x
    0x41, 0xfc, 0xff, 0x03, 0x71, 0x21, 0x03, // x & 0xfffc = address
    0x20, 0x03, 0x20, 0x03, 0x28, 0x02, 0x00, // memory[address]
    0x20, 0x01, 0x6a, 0x36, 0x02, 0x00, // + x = memory[address]
    0x20, 0x02, 0x20, 0x01, 0xb7, // sum, f64(x)
    0x44, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0xe0, 0x3f, 0xa2, // * 0.5
    0xa0, 0x21, 0x02, // + = sum
    0x20, 0x00, 0x41, 0x01, 0x6b, 0x22, 0x00, 0x0d, 0x00, 0x0b, // again while --n != 0
    0x20, 0x02, 0xfc, 0x02, 0x20, 0x01, 0x6a, 0x0b, // return i32(sum) + x
];

/// Measures the fuel units that code of lambdas takes in a second of CPU time on this machine. The
/// load by other programs does not count.
///
/// # Errors
///
/// [`CompileError::Engine`] if this machine does not support the engine.
pub fn fuel_per_second() -> Result<f64, CompileError> {
    let failed = |source: wasmtime::Error| CompileError::Engine { source: source.into() };
    let engine = engine(GUEST_STACK_BYTES, Nans::Native)?;
    let module = Module::new(&engine, LOOP).map_err(failed)?;
    let mut store = Store::new(&engine, ());
    store.set_epoch_deadline(1);
    store.set_fuel(u64::MAX).map_err(failed)?;
    let instance = Instance::new(&mut store, &module, &[]).map_err(failed)?;
    let run = instance.get_typed_func::<i32, i32>(&mut store, "run").map_err(failed)?;
    // The first call waits for pages and for the clock of the processor.
    run.call(&mut store, ITERATIONS).map_err(failed)?;
    let (started, before) = (cpu_time(), store.get_fuel().map_err(failed)?);
    loop {
        run.call(&mut store, ITERATIONS).map_err(failed)?;
        let took = cpu_time().saturating_sub(started);
        if took >= TIME {
            let fuel = before - store.get_fuel().map_err(failed)?;
            return Ok(fuel as f64 / took.as_secs_f64());
        }
    }
}

fn cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    Duration::new(seconds, u32::try_from(time.tv_nsec).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_speed_of_this_machine_is_measured() {
        let speed = super::fuel_per_second().unwrap();
        // No machine that runs this test takes one unit in a microsecond, or a thousand in a
        // nanosecond.
        assert!((1e6..1e12).contains(&speed), "{speed}");
    }
}
