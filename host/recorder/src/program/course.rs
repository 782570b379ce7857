//! The loop: it owns the recorder. It takes its turns in small pieces, so that a trigger is heard within a fraction of a
//! millisecond, whatever else there is to do.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, Builder};
use std::time::{Duration, Instant};

use gleaner_protocol::link::RecorderReport;
use gleaner_protocol::manifest::Store;
use gleaner_protocol::{Exit, Failure};
use gleaner_transport::dds::Clock;
use gleaner_vitals::Spreads;
use tracing::{error, warn};

use super::Options;
use super::commands::Commands;
use super::hear::{Announced, Event, starter};
use super::lambdas::Lambda;
use super::say::Say;
use super::staging::{Arrivals, Block, Lane, Staging};
use super::telling::Said;
use super::watch::{Beat, Feed, Seen, Want, Wanted, Watch};
use crate::{Folder, RecordError, Recorder, Settings, TopicId, Work};

/// Lambdas that are heard at a time. Each has a thread.
const LAMBDAS: usize = 256;
/// Events that wait for the loop.
const EVENTS: usize = 256;
/// Samples and bytes that are taken before triggers are looked for again.
const SAMPLES_TURN: usize = 64;
const BYTES_TURN: usize = 256 << 10;
/// How long nobody looks for samples, if nothing else happens.
const LOOK: Duration = Duration::from_millis(5);
/// And for the thread that writes, if that is behind.
const BEHIND: Duration = Duration::from_millis(1);
/// A sample is stamped before it is staged: time passes for the recorder only when all up to then must have come.
const MARGIN_NS: i64 = 100_000_000;
/// How long the last words of lambdas may take.
const LAST_WORDS: Duration = Duration::from_secs(1);
const LAST_LOOK: Duration = Duration::from_millis(2);
/// Bytes of the largest sample of a topic of which no manifest says more, as far as room for it goes.
const USUAL_BYTES: usize = 8 << 20;
/// Room for staged samples: twice as much is taken.
const STAGING: std::ops::RangeInclusive<usize> = 8 << 20..=256 << 20;
/// Room on the disk above the floor from which on clips are begun again.
const SLACK: u64 = 64 << 20;

/// Records until it is to end.
pub(super) fn run(
    options: Options,
    feed: impl FnOnce() -> Result<Box<dyn Feed>, Failure>,
    control: OwnedFd,
    reports: File,
    stop: Arc<AtomicBool>,
) -> Result<(), Failure> {
    let internal = |error: std::io::Error| Failure::caused_by(Exit::Internal, "cannot start a thread", &error);
    let (mut folder, recovered) = Folder::open(&options.out)?;
    let mut say = Say::start(reports, options.out.join("losses.jsonl")).map_err(internal)?;
    for clip in recovered {
        warn!(clip = %clip.file.display(), "recovered a clip of an earlier recorder, which did not end well");
        say.say(RecorderReport::Recovered(Box::new(clip)));
    }
    let mut deleted = Vec::new();
    if options.clips_max.is_some() || options.bytes_max.is_some() {
        deleted = folder.keep_at_most(options.clips_max, options.bytes_max)?;
    }
    let settings = Settings {
        store: Store::Ram,
        preroll_bytes: options.preroll_bytes.unwrap_or(1 << 20),
        max_length: Duration::from_secs(1),
        folder: options.out.clone(),
        clock: format!("CLOCK_MONOTONIC, {} ns ahead", options.clock.offset_ns()),
        prefault: true,
    };
    let mut recorder = Recorder::live(folder, settings)?;
    recorder.advance(options.clock.now())?;
    let (events, inbox) = sync_channel(EVENTS);
    let (wants, wanted) = sync_channel(EVENTS);
    let reader = thread::current();
    let watch = Watch {
        feed: feed()?,
        wants: wanted,
        events: events.clone(),
        reader: reader.clone(),
        out: options.out.clone(),
    };
    let watch = Builder::new().name("watch".to_owned()).spawn(move || watch.run()).map_err(internal)?;
    starter(control, events, reader.clone()).map_err(internal)?;
    let commands = options.commands.clone().map(|name| {
        let (commands, sink) = Commands::new(name.clone(), reader.clone());
        let _ = wants.send(Want { what: Wanted::Commands, name, sink });
        commands
    });
    say.say(RecorderReport::Ready);
    let mut course = Course {
        recorder,
        clock: options.clock,
        staging: Staging::new(*STAGING.start(), reader),
        block: Block::new(*STAGING.start()),
        at: 0,
        room: *STAGING.start(),
        inbox,
        wants,
        commands,
        lambdas: Vec::new(),
        topics: BTreeMap::new(),
        asked: BTreeMap::new(),
        said: Said::default(),
        beat: Beat::default(),
        spreads: Spreads::new(),
        wakes_lost: 0,
        triggers_refused: 0,
        deleted_before: deleted.len() as u64,
        is_ending: false,
        options,
        stop,
        say,
    };
    deleted.into_iter().for_each(|loss| course.say.say(RecorderReport::Loss(loss)));
    let ended = course.turns();
    let last = course.last_words();
    // A watch that waits for room in the inbox would never end.
    drop((course.wants, course.inbox));
    course.say.end(RecorderReport::Ended(Box::new(last)));
    // It ends by itself, and with it the network.
    let _ = watch.join();
    ended
}

/// A topic that is recorded.
pub(super) struct Recorded {
    pub(super) name: String,
    pub(super) type_name: Option<String>,
    pub(super) arrivals: Arc<Arrivals>,
}

pub(super) struct Course {
    pub(super) recorder: Recorder,
    pub(super) clock: Clock,
    staging: Arc<Staging>,
    /// Samples that are being taken, and up to which they are.
    block: Block,
    at: usize,
    /// How much room there is to be.
    room: usize,
    inbox: Receiver<Event>,
    wants: SyncSender<Want>,
    pub(super) commands: Option<Commands>,
    pub(super) lambdas: Vec<Lambda>,
    pub(super) topics: BTreeMap<TopicId, Recorded>,
    /// By lambda: what it asks of the preroll, and bytes that it expects in a second.
    asked: BTreeMap<String, (Store, u64, usize)>,
    pub(super) said: Said,
    pub(super) beat: Beat,
    pub(super) spreads: Spreads,
    pub(super) wakes_lost: u64,
    pub(super) triggers_refused: u64,
    pub(super) deleted_before: u64,
    is_ending: bool,
    options: Options,
    stop: Arc<AtomicBool>,
    pub(super) say: Say,
}

impl Course {
    fn turns(&mut self) -> Result<(), Failure> {
        loop {
            let mut is_busy = self.events()?;
            is_busy |= self.listen()?;
            if let Some(commands) = &mut self.commands {
                is_busy |= commands.obey(&mut self.recorder)?;
            }
            is_busy |= self.samples(SAMPLES_TURN)?;
            let work = self.recorder.work()?;
            self.tell(false)?;
            if let Some(why) = self.beat.pulse.dead.take() {
                self.finish()?;
                return Err(Failure { causes: vec![why], ..Failure::new(Exit::Internal, "the network is dead") });
            }
            if self.is_ending || self.stop.load(Ordering::Relaxed) {
                return self.finish();
            }
            if !is_busy && work != Work::More {
                thread::park_timeout(if work == Work::Wait { BEHIND } else { LOOK });
            }
        }
    }

    /// Hears the starter and the watch.
    fn events(&mut self) -> Result<bool, Failure> {
        let mut heard = false;
        while let Ok(event) = self.inbox.try_recv() {
            heard = true;
            match event {
                Event::Announced(announced) => self.announce(*announced)?,
                Event::Stop => self.is_ending = true,
                Event::Seen(Seen::Found { topic, of }) => {
                    let type_name = of.type_name.clone();
                    match (self.recorder.found_topic(topic, of), self.topics.get_mut(&topic)) {
                        (Ok(()), Some(recorded)) => recorded.type_name = Some(type_name),
                        (Ok(()), None) => {}
                        (Err(error), _) => {
                            error!(error = &error as &dyn std::error::Error, "a topic is not recorded");
                        }
                    }
                }
                Event::Seen(Seen::Pulse(beat)) => {
                    self.beat = *beat;
                    self.look_at_disk()?;
                }
            }
        }
        Ok(heard)
    }

    /// A lambda will come: its topics are wanted from now on, so that there is a preroll when it does.
    fn announce(&mut self, announced: Announced) -> Result<(), Failure> {
        let Announced { manifest, remaps, spoken, mut answers } = announced;
        let Some(rules) = manifest.record.clone() else { return Ok(()) };
        let name = manifest.lambda.name.to_string();
        if self.lambdas.len() == LAMBDAS {
            warn!(lambda = %name, most = LAMBDAS, "too many lambdas at a time: not recorded for");
            answers.refused(&format!("it hears at most {LAMBDAS} lambdas at a time"));
            return Ok(());
        }
        let mut topics = Vec::new();
        let mut largest = 0;
        for wanted in &rules.topics {
            let remapped = remaps.iter().find(|(from, _)| from == wanted.as_str()).map(|(_, to)| to.as_str());
            let input = manifest.inputs.iter().find(|input| input.topic == *wanted);
            let max_bytes = input.map(|input| input.max_size.as_usize());
            largest = largest.max(max_bytes.unwrap_or(USUAL_BYTES));
            match self.want(remapped.unwrap_or(wanted.as_str()), max_bytes) {
                Ok(topic) if !topics.contains(&topic) => topics.push(topic),
                Ok(_) => {}
                Err(error) => {
                    let why = error.to_string();
                    warn!(lambda = %name, topic = %wanted, %why, "a lambda cannot be recorded for");
                    answers.refused(&why);
                    return Ok(());
                }
            }
        }
        let seconds = rules.preroll.as_secs_f64().max(1.0);
        let per_s = (rules.preroll_size.bytes() as f64 / seconds) as usize;
        self.asked.insert(name.clone(), (rules.store, rules.preroll_size.bytes(), per_s));
        let per_s: usize = self.asked.values().map(|(_, _, per_s)| *per_s).fold(0, usize::saturating_add);
        let wanted = largest.saturating_add(per_s).clamp(*STAGING.start(), *STAGING.end());
        self.room = self.room.max(wanted);
        let store = if self.asked.values().any(|asked| asked.0 == Store::Disk) { Store::Disk } else { Store::Ram };
        let bytes = self.asked.values().map(|asked| asked.1).fold(0, u64::saturating_add);
        match self.options.preroll_bytes {
            // What is given is memory.
            Some(given) if store == Store::Ram => {
                if given < bytes {
                    warn!(asked = bytes, given, "lambdas ask for more preroll than the recorder was given");
                }
            }
            _ => self.recorder.grow_preroll(store, bytes)?,
        }
        self.recorder.grow_length(rules.max_length);
        self.lambdas.push(Lambda::new(name, rules, topics, spoken, answers));
        Ok(())
    }

    fn want(&mut self, name: &str, max_bytes: Option<usize>) -> Result<TopicId, RecordError> {
        let topic = self.recorder.add_missing_topic(name)?;
        if !self.topics.contains_key(&topic) {
            let arrivals = Arc::<Arrivals>::default();
            let lane = Lane { topic, staging: Arc::clone(&self.staging), arrivals: Arc::clone(&arrivals) };
            // The watch takes them as they come; there are at most 256.
            let what = Wanted::Recorded { topic, max_bytes };
            let _ = self.wants.send(Want { what, name: name.to_owned(), sink: Arc::new(lane) });
            self.topics.insert(topic, Recorded { name: name.to_owned(), type_name: None, arrivals });
        }
        Ok(topic)
    }

    /// Below the floor no clip is begun, and the open one ends.
    fn look_at_disk(&mut self) -> Result<(), Failure> {
        let (Some(free), floor) = (self.beat.disk_free, self.options.disk_floor) else { return Ok(()) };
        let is_held = self.recorder.is_held();
        if free < floor && !is_held {
            let why = format!("less than {} MiB of the disk were free", floor >> 20);
            warn!(free, floor, "the disk has too little room: nothing is recorded");
            self.recorder.hold(Some(&why))?;
            if let Some(commands) = &mut self.commands {
                commands.forget_running();
            }
        } else if is_held && free >= floor.saturating_add(SLACK) {
            warn!(free, floor, "the disk has room again");
            self.recorder.hold(None)?;
        }
        Ok(())
    }

    fn listen(&mut self) -> Result<bool, Failure> {
        let mut heard = false;
        let mut index = 0;
        while index < self.lambdas.len() {
            let (now, clock) = (self.clock.now(), self.clock);
            let monotonic = || clock.monotonic(clock.now());
            let listened = self.lambdas[index].listen(&mut self.recorder, now, monotonic, &mut self.spreads)?;
            heard |= listened.heard;
            self.wakes_lost += listened.wakes_lost;
            self.triggers_refused += listened.triggers_refused;
            if let (Some(commands), Some(id)) = (&mut self.commands, listened.is_new) {
                commands.add(&self.lambdas[index].name, id);
            }
            if listened.is_gone {
                self.lambdas.swap_remove(index);
            } else {
                index += 1;
            }
        }
        Ok(heard)
    }

    /// Takes some of the samples that came; `true` if there may be more.
    fn samples(&mut self, most: usize) -> Result<bool, Failure> {
        let (mut samples, mut bytes) = (0, 0);
        while let Some((staged, cdr)) = self.block.get(self.at) {
            if samples == most || bytes >= BYTES_TURN {
                return Ok(true);
            }
            match staged.bytes {
                Some(_) => self.recorder.sample(staged.topic, &staged.meta, cdr)?,
                None => self.recorder.lost_sample(staged.topic, &staged.meta),
            }
            (self.at, samples, bytes) = (self.at + 1, samples + 1, bytes + cdr.len());
        }
        let now = self.clock.now();
        let mut empty = std::mem::take(&mut self.block);
        if empty.room() < self.room {
            empty = Block::new(self.room);
        }
        empty.clear();
        (self.block, self.at) = (self.staging.exchange(empty), 0);
        if self.block.get(0).is_none() {
            self.recorder.advance(now.saturating_sub(MARGIN_NS))?;
            return Ok(false);
        }
        // A topic is told before its first sample.
        self.events()?;
        Ok(true)
    }

    /// Takes what has come, and completes what is open.
    fn finish(&mut self) -> Result<(), Failure> {
        // Their processes have ended, or will: what they said before is still on its way.
        let until = Instant::now() + LAST_WORDS;
        while !self.lambdas.is_empty() && Instant::now() < until {
            if !self.listen()? {
                thread::park_timeout(LAST_LOOK);
            }
        }
        let end = self.clock.now();
        // Three blocks at most: what comes in another is later than the end.
        let mut blocks = 0;
        while blocks < 4 && self.samples(usize::MAX)? {
            blocks += u32::from(self.at == 0);
        }
        self.recorder.finish(end)?;
        self.tell(true)
    }
}
