//! Tests with random drives: each clip contains exactly what a brute-force computation of all
//! windows gives.

use std::collections::BTreeMap;
use std::time::Duration;

use super::support::*;
use gleaner_lambda::TriggerKind::{self, Event, Start, Stop};
use gleaner_lambda::manifest::Store;

/// A drive and what is done with it, all in ms.
struct Plan {
    /// Preroll, postroll and cooldown of each lambda, and its topics.
    lambdas: Vec<((i64, i64, i64), Vec<usize>)>,
    /// Topic and stamp.
    samples: Vec<(usize, i64)>,
    /// Stamp, lambda and kind; each comes after the samples of its stamp.
    triggers: Vec<(i64, usize, TriggerKind)>,
    end: i64,
}

const TOPICS: [&str; 4] = ["/a", "/b", "/c", "/d"];

fn plan(seed: u64) -> Plan {
    let mut random = SeededRandom(seed);
    let lambdas = 1 + random.below(3);
    let lambdas = (0..lambdas)
        .map(|_| {
            let topics: Vec<_> = (0..TOPICS.len()).filter(|_| random.below(2) == 0).collect();
            let topics = if topics.is_empty() { vec![0] } else { topics };
            (
                (
                    random.below(800),
                    random.below(500),
                    [0, random.below(900)][random.below(2) as usize],
                ),
                topics,
            )
        })
        .collect::<Vec<_>>();
    let (mut samples, mut triggers, mut now) = (Vec::new(), Vec::new(), 0);
    for _ in 0..400 {
        now += [0, 1, random.below(20), random.below(60)][random.below(4) as usize];
        if random.below(100) == 0 {
            now += random.below(4000);
        }
        samples.push((random.below(TOPICS.len() as u64) as usize, now));
        if random.below(25) == 0 {
            let lambda = random.below(lambdas.len() as u64) as usize;
            triggers.push((
                now,
                lambda,
                [Event, Event, Start, Stop, Stop][random.below(5) as usize],
            ));
        }
    }
    // Samples of one instant come before its triggers.
    samples.sort_by_key(|(_, at)| *at);
    Plan { lambdas, samples, triggers, end: now + random.below(500) }
}

/// Topic, stamp and number of each message of a clip, sorted.
type Contents = Vec<(String, i64, u32)>;

/// The contents of each clip, by brute force.
fn expected(plan: &Plan) -> Vec<Contents> {
    let rolls: Vec<_> = plan.lambdas.iter().map(|(rolls, _)| *rolls).collect();
    let groups = model_groups(&rolls, &plan.triggers);
    let holds = |group: &[ModelWindow], topic: usize, at: i64| {
        group.iter().any(|(lambda, from, to)| {
            plan.lambdas[*lambda].1.contains(&topic) && *from <= at && at <= *to
        })
    };
    let contents = |group: &Vec<ModelWindow>| {
        let inside =
            plan.samples.iter().enumerate().filter(|(_, (topic, at))| holds(group, *topic, *at));
        let mut inside: Vec<_> = inside
            .map(|(seq, (topic, at))| (TOPICS[*topic].to_owned(), T0 + at * MS, seq as u32 + 1))
            .collect();
        inside.sort();
        inside
    };
    groups.iter().map(contents).collect()
}

/// The contents of the recorder's clips, and why each is incomplete.
fn recorded(plan: &Plan, store: Store, max_length: Duration) -> Vec<(Contents, Vec<String>)> {
    let scratch = TestDir::new();
    let mut recorder =
        scratch.recorder(|settings| (settings.store, settings.max_length) = (store, max_length));
    let topics = TOPICS.map(|name| recorder.add_topic(topic(name)).unwrap());
    let lambdas: Vec<_> = (plan.lambdas.iter().enumerate())
        .map(|(index, (rolls, own))| {
            let own: Vec<_> = own.iter().map(|topic| topics[*topic]).collect();
            recorder.add_lambda(member(&format!("lambda-{index}"), *rolls, &own))
        })
        .collect();
    let mut triggers = plan.triggers.iter().peekable();
    for (index, (topic, at)) in plan.samples.iter().enumerate() {
        recorder
            .sample(topics[*topic], &meta(T0 + at * MS, index as u64 + 1), &[index as u8; 50])
            .unwrap();
        let is_last_of_its_instant = plan.samples.get(index + 1).is_none_or(|(_, next)| next > at);
        while let Some((_, lambda, kind)) =
            triggers.next_if(|(when, _, _)| is_last_of_its_instant && when == at)
        {
            recorder.wake(lambdas[*lambda], &entry(T0 + at * MS, &[*kind])).unwrap();
        }
    }
    recorder.finish(T0 + plan.end * MS).unwrap();
    assert_eq!(recorder.counts().out_of_order, 0);
    let clips = recorder.clips().iter().map(|clip| {
        let contents = scratch.contents(clip);
        let mut counted = BTreeMap::new();
        contents.iter().for_each(|(topic, _, _)| *counted.entry(topic.clone()).or_insert(0) += 1);
        for topic in &clip.topics {
            let messages = counted.remove(&topic.topic).unwrap_or(0);
            let expected = (messages, Some(messages), Some(0));
            assert_eq!((topic.messages, topic.received, topic.overwritten), expected);
        }
        assert!(counted.is_empty(), "a topic that the clip does not list: {counted:?}");
        (contents, clip.incomplete.clone())
    });
    clips.collect()
}

#[test]
fn clips_of_random_drives_equal_those_by_brute_force() {
    let mut made = 0;
    for seed in 0..60 {
        let plan = plan(seed);
        let clips = recorded(&plan, Store::Ram, Duration::from_secs(3600));
        let contents: Vec<_> = clips.into_iter().map(|(contents, _)| contents).collect();
        assert_eq!(contents, expected(&plan), "seed {seed}");
        made += contents.iter().filter(|contents| contents.len() > 5).count();
    }
    assert!(made > 120, "{made} clips are too few to mean anything");
}

#[test]
fn clips_from_memory_and_from_disk_are_equal() {
    for seed in 100..120 {
        let (plan, max_length) = (plan(seed), Duration::from_millis(700));
        let [ram, disk] = [Store::Ram, Store::Disk].map(|store| recorded(&plan, store, max_length));
        assert_eq!(ram, disk, "seed {seed}");
    }
}

#[test]
fn consecutive_clips_contain_together_what_one_would() {
    for seed in 200..240 {
        let plan = plan(seed);
        let mut groups = Vec::<Vec<_>>::new();
        for (contents, short) in recorded(&plan, Store::Ram, Duration::from_millis(300)) {
            let span = contents.iter().map(|(_, at, _)| *at);
            let span = span.clone().max().unwrap_or(0) - span.min().unwrap_or(0);
            let continues = short.contains(&"continues the clip before".to_owned());
            assert!(span <= 300 * MS || continues, "seed {seed}: a first clip of {span} ns");
            match groups.last_mut() {
                Some(group) if continues => group.extend(contents),
                _ => groups.push(contents),
            }
        }
        // Equal lists: nothing is lost or duplicated.
        groups.iter_mut().for_each(|group| group.sort());
        assert_eq!(groups, expected(&plan), "seed {seed}");
    }
}

#[test]
fn triggers_without_messages_make_clips_of_the_longest_length() {
    let scratch = TestDir::new();
    let mut recorder =
        scratch.recorder(|settings| settings.max_length = Duration::from_millis(500));
    let topic = recorder.add_topic(topic("/silent")).unwrap();
    let lambda = recorder.add_lambda(member("l", (100, 100, 0), &[topic]));
    for step in 0..20 {
        let at = T0 + step * 100 * MS;
        recorder.advance(at).unwrap();
        recorder.wake(lambda, &entry(at, &[Event])).unwrap();
    }
    let before = recorder.clips().len();
    assert!(before >= 3, "{before}");
    recorder.finish(T0 + 2000 * MS).unwrap();
    let triggers: u64 = recorder.clips().iter().map(|clip| clip.triggers).sum();
    assert_eq!(triggers, 20);
}
